"""The command line of `console`: what it understands, and what it refuses in one line."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from needle_bringup.simulation.simulate_options import SimulateOptions, parse
from needle_core.commands.options import CommandParser, join_signed_values, whole_number

DESCRIPTION = """\
Steer a simulated needle by hand, in a browser, in real time.

Runs sim_rig, plane_controller (at level drive also drive_emulator and device_driver) and the
console in one process, cameras and stereo_tracker in a second one, and prints the address to open.
With --graph each is a ROS node of this shell's domain, with live_view for RViz and Foxglove.
Nothing moves before you have pressed the buttons in their order; Ctrl-C ends all.
"""

EPILOG = """\
examples:
  scripts/console
      camera images, the page on http://127.0.0.1:8080/
  scripts/console --level tip
      no images: for a slow machine
  scripts/console --level drive --port 9000
      the device driver moves two emulated CANopen drives; page and hold on ports 9000 and 9001
  scripts/console --graph
      ROS nodes, to look at with `ros2 topic echo`, RViz or Foxglove as well

exit codes: 130 ended by Ctrl-C, 1 a part of the rig ended before, 2 bad input or something missing.
"""

# Options that mean what they mean for `simulate`.
_SHARED = {
    "--level": ("tip|camera|drive", "what is simulated (default: camera)"),
    "--controller": ("paper|best|open_loop", "how the needle is turned (default: best)"),
    "--insertion": (
        "continuous|stepwise",
        "without a stop, or 1 mm at a time (default: continuous)",
    ),
    "--initial": ("X_MM,PITCH_DEG,ROLL_DEG", "where the needle starts (default: -3,2,15)"),
    "--noise-mm": ("A", "level tip: how far off a measured tip may be (default: 1.0)"),
    "--depth-mm": ("D", "how far to insert (default: 120)"),
    "--seed": ("N", "seed of all noise (default: 1)"),
}
# The page's, and the hold's beside it.
_DEFAULT_PORT, _LAST_PORT = "8080", 65534
LOOPBACK = "127.0.0.1"
"""Where page and hold are served."""


@dataclasses.dataclass(frozen=True)
class ConsoleOptions:
    """Options of `console`.

    Attributes
    ----------
    port : int
        Of the page; the hold's is the next.
    rig : SimulateOptions
        What is simulated, in real time.
    """

    port: int
    rig: SimulateOptions


def parse_console(arguments: Sequence[str]) -> ConsoleOptions:
    """Return the options of a command line (without the program's name).

    Raises
    ------
    UserError
        Anything that cannot be run as asked.
    """
    parser = CommandParser("console", DESCRIPTION, EPILOG)
    parser.add_argument(
        "--port",
        default=_DEFAULT_PORT,
        metavar="N",
        help=f"port of the page; the hold takes the next (default: {_DEFAULT_PORT})",
    )
    parser.add_argument("--graph", action="store_true", help="run ROS nodes, for RViz and Foxglove")
    for option, (metavar, text) in _SHARED.items():
        parser.add_argument(option, metavar=metavar, help=text)
    given = parser.parse_args(join_signed_values(arguments))
    # Who steers by hand decides how fast the needle goes, and not where it stops in between.
    words = ["--graph"] if given.graph else ["--real-time-factor", "1"]
    words += ["--insertion", "continuous"]
    for option in _SHARED:
        value = getattr(given, option[2:].replace("-", "_"))
        if value is not None:
            words.append(f"{option}={value}")
    port = whole_number("--port", given.port, 1, _LAST_PORT)
    return ConsoleOptions(port, parse(words))
