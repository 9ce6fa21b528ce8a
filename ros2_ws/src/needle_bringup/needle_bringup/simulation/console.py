"""A simulated rig in real time with the web console: `scripts/console`."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from needle_bringup.simulation.rig_configuration import command_line_parameters
from needle_bringup.simulation.simulate_options import SimulateOptions, parse
from needle_core.commands.cli import EXIT_INTERRUPTED, EXIT_MISSED, run_command
from needle_core.commands.options import CommandParser, join_signed_values, whole_number
from needle_core.process.shutdown import ShutdownFlag
from needle_core.settings.parameter_files import Parameters

if TYPE_CHECKING:
    from needle_core.component import Component, RealPort

DESCRIPTION = """\
Steer a simulated needle by hand, in a browser, in real time.

Runs sim_rig, plane_controller, the console and, at level drive, drive_emulator and device_driver in
one process, cameras and stereo_tracker in a second one, and prints the address to open. With
--graph they are ROS nodes in this shell's domain, together with live_view for RViz and Foxglove.
Nothing moves until you press the buttons in their order; Ctrl-C ends everything.
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
      ROS nodes, also for `ros2 topic echo`, RViz and Foxglove

exit codes: 130 ended by Ctrl-C; 1 a component exited; 2 invalid or missing input
"""

# Options with the same meaning as those of `simulate`.
_SHARED = {
    "--level": (
        "tip|camera|drive",
        "what is simulated: tips, images, or images and drives (default: camera)",
    ),
    "--controller": ("paper|best|open_loop", "preset that rotates the needle (default: best)"),
    "--insertion": (
        "continuous|stepwise",
        "without stops, or in steps of 1 mm (default: continuous)",
    ),
    "--initial": ("X_MM,PITCH_DEG,ROLL_DEG", "initial pose of the needle (default: -3,2,15)"),
    "--noise-mm": ("A", "level tip: maximum error of each coordinate [mm] (default: 1.0)"),
    "--depth-mm": ("D", "final insertion [mm] (default: 120)"),
    "--seed": ("N", "seed of all random numbers (default: 1)"),
}
# The hold uses the port after that of the page.
_DEFAULT_PORT, _LAST_PORT = "8080", 65534
LOOPBACK = "127.0.0.1"
"""Address of page and hold."""
# Display rate of the page [Hz].
_CAMERA_RATE = 10.0
_SLICE = 0.2
# The person at the page replaces the simulated operator, and nothing is recorded.
_LEFT_OUT = ("simulated_operator", "recorder")
_POLL = 0.1


@dataclasses.dataclass(frozen=True)
class ConsoleOptions:
    """Options of `console`.

    Attributes
    ----------
    port : int
        Port of the page; the hold uses the next one.
    rig : SimulateOptions
        The rig, simulated in real time.
    """

    port: int
    rig: SimulateOptions


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `console`; return its exit code."""
    argv = sys.argv[1:] if arguments is None else arguments
    return run_command(lambda: console(parse_console(argv)))


def parse_console(arguments: Sequence[str]) -> ConsoleOptions:
    """Return the options of a command line (without the program's name).

    Raises
    ------
    UserError
        If an option is invalid.
    """
    parser = CommandParser("console", DESCRIPTION, EPILOG)
    parser.add_argument(
        "--port",
        default=_DEFAULT_PORT,
        metavar="N",
        help=f"port of the page; the hold uses the next one (default: {_DEFAULT_PORT})",
    )
    parser.add_argument("--graph", action="store_true", help="run ROS nodes, for RViz and Foxglove")
    for option, (metavar, text) in _SHARED.items():
        parser.add_argument(option, metavar=metavar, help=text)
    given = parser.parse_args(join_signed_values(arguments))
    argv = ["--graph"] if given.graph else ["--real-time-factor", "1"]
    argv += ["--insertion", "continuous"]
    for option in _SHARED:
        value = getattr(given, option[2:].replace("-", "_"))
        if value is not None:
            argv.append(f"{option}={value}")
    port = whole_number("--port", given.port, 1, _LAST_PORT)
    return ConsoleOptions(port, parse(argv))


def console(options: ConsoleOptions) -> int:
    """Run rig and page until a signal arrives.

    Parameters
    ----------
    options : ConsoleOptions
        Options of the command line.

    Returns
    -------
    int
        130 after a signal, 1 if a component ended earlier.

    Raises
    ------
    UserError
        If a file or package is missing, a port is in use, or a node ended.
    """
    with ShutdownFlag() as end:
        run = run_nodes if options.rig.graph else _run_components
        return run(options, rig_parameters(options), end)


def rig_parameters(options: ConsoleOptions) -> Parameters:
    """Return the parameters of the rig's nodes, by name."""
    parameters = command_line_parameters(options.rig, Path())
    parameters["sim_rig"]["camera_rate"] = _CAMERA_RATE
    return parameters


def _run_components(options: ConsoleOptions, parameters: Parameters, end: ShutdownFlag) -> int:
    # One thread per process, because the matrices are small; numpy reads this when it is loaded.
    os.environ.update({"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"})
    from needle_console.console import PAGE, Console  # noqa: PLC0415
    from needle_console.console_parameters import ConsoleParameters  # noqa: PLC0415
    from needle_console.page.web_server import ServedPagePort  # noqa: PLC0415
    from needle_core.runners.paced import PacedRunner  # noqa: PLC0415

    settings = ConsoleParameters(address=LOOPBACK, port=options.port, hold_port=options.port + 1)
    page = ServedPagePort(settings)
    rig, ports = _make_rig(parameters)
    components = [*rig, Console(settings)]
    runner = PacedRunner(components, options.rig.seed, ports={PAGE: page, **ports})
    with contextlib.closing(runner):
        _print_address(options)
        while not end.requested:
            if runner.run(_SLICE):
                (name, ended), *_ = runner.exits.items()
                print(f"error: {name} ended: {ended.text}", file=sys.stderr)
                return EXIT_MISSED
            page.set_lag(runner.lag)
    return EXIT_INTERRUPTED


def _make_rig(parameters: Parameters) -> tuple[list[Component], dict[str, RealPort]]:
    """Return the rig, and its ports to other processes."""
    from needle_bringup.simulation.virtual_run import make_rig  # noqa: PLC0415

    if parameters["sim_rig"]["level"] == "tip":
        return make_rig(parameters), {}
    from needle_bringup.simulation.remote_tracker import (  # noqa: PLC0415
        VISION,
        RemoteTracker,
        make_vision,
    )
    from needle_core.ports.worker_process import WorkerProcess  # noqa: PLC0415
    from needle_sim.cameras import RemoteCameras  # noqa: PLC0415

    rig = make_rig(parameters, RemoteCameras, lambda _: RemoteTracker())
    return rig, {VISION: WorkerProcess(make_vision, parameters)}


def run_nodes(options: ConsoleOptions, rig: Parameters, end: ShutdownFlag) -> int:
    """Run the rig, its page and its live view as nodes in this shell's ROS domain.

    Parameters
    ----------
    options : ConsoleOptions
        Options of the command line.
    rig : Parameters
        Parameters by node.
    end : ShutdownFlag
        Flag that ends the run.

    Returns
    -------
    int
        130 after a signal.

    Raises
    ------
    NodeFailedError
        If a node ended earlier.
    """
    from needle_bringup.simulation.launch_nodes import LAUNCHED_PACKAGES  # noqa: PLC0415
    from needle_bringup.simulation.node_graph import NodeGraph, wait_for  # noqa: PLC0415
    from needle_core.process.discovery import clean_environment  # noqa: PLC0415

    clean_environment()
    nodes = {name: values for name, values in rig.items() if name not in _LEFT_OUT}
    nodes["console"] = {"port": options.port, "hold_port": options.port + 1}
    packages = {**LAUNCHED_PACKAGES, "console": "needle_console"}
    folder = Path(tempfile.mkdtemp(prefix="needle_console_"))
    graph = NodeGraph(folder, nodes)
    try:
        for name in (*nodes, "live_view"):
            graph.start(packages[name], name)
        _print_address(options)
        while not end.requested:
            graph.check()
            wait_for([graph.nodes["console"]], _POLL)
    finally:
        graph.stop()
    shutil.rmtree(folder)
    return EXIT_INTERRUPTED


def _print_address(options: ConsoleOptions) -> None:
    print(f"http://{LOOPBACK}:{options.port}/   (Ctrl-C ends all)", flush=True)


if __name__ == "__main__":
    sys.exit(main())
