"""The `console` executable: `Console` as a ROS node, with the servers of its page."""

from __future__ import annotations

import importlib.util
import sys

from needle_console.console import PAGE, Console
from needle_console.console_parameters import ConsoleParameters
from needle_core.commands.cli import EXIT_BAD_INPUT
from needle_core.ros.main import run_component

HELP = """\
console: serves a web page with the state of the rig and a hold button to steer the needle.

Publishes   device/hold (always; pressed only while the button is held), target_plane, target_point
Subscribes  device/status, needle/controller_status, joint_states, needle/tip_pose, needle/estimate,
            target_plane, needle/proposed_target, /diagnostics; stereo/{left,right}/image_raw (while
            a page is open)
Calls       device/{confirm_needle_out,home,enable,stop,retract,reset},
            plane_controller/{start,stop}
"""


def main() -> int:
    """Run the console; return its exit code."""
    if importlib.util.find_spec("nicegui") is None:
        print("error: NiceGUI is not installed; scripts/console installs it", file=sys.stderr)
        return EXIT_BAD_INPUT
    # This import needs NiceGUI.
    from needle_console.page.web_server import ServedPagePort  # noqa: PLC0415

    return run_component(
        Console.name,
        ConsoleParameters,
        lambda settings, _: Console(settings),
        help_text=HELP,
        ports=lambda settings: {PAGE: ServedPagePort(settings)},
    )


if __name__ == "__main__":
    sys.exit(main())
