"""console: the rig in a browser, and a hold to steer it by."""

from __future__ import annotations

import importlib.util
import sys
from functools import partial

from rclpy.node import Node

from needle_console.access.access import Access
from needle_console.page.desk import Desk
from needle_console.ros.console_node import ConsoleNode
from needle_console.ros.console_parameters import ConsoleParameters
from needle_core.commands.cli import EXIT_BAD_INPUT, EXIT_DONE
from needle_core.process.end_request import EndRequest
from needle_core.ros.base_node import executor_of, run_node

# What cannot wait has threads of its own: a signal is seen so late at most [s].
_LOOK_PERIOD = 0.2
HELP = """\
console: serves a page that shows what the rig sees and believes, with a hold to steer it by.

Publishes   device/hold (always; pressed only while a person holds), target_plane, target_point
Subscribes  device/status, needle/controller_status, joint_states, needle/tip_pose, needle/estimate,
            target_plane, /diagnostics, and while a page is open stereo/{left,right}/image_raw
Calls       device/{confirm_needle_out,home,enable,stop,retract,reset},
            plane_controller/{start,stop}
"""


def main() -> int:
    """Run the console; returns its exit code."""
    if importlib.util.find_spec("nicegui") is None:
        print("error: NiceGUI is not installed; scripts/console installs it", file=sys.stderr)
        return EXIT_BAD_INPUT
    # What cannot be imported without NiceGUI is imported where it is there.
    from needle_console.hold.hold_server import HoldServer  # noqa: PLC0415
    from needle_console.page.console_page import HoldLink  # noqa: PLC0415
    from needle_console.page.web_server import WebServer  # noqa: PLC0415

    def make_page(
        desk: Desk, access: Access, parameters: ConsoleParameters, token: str
    ) -> WebServer:
        at = parameters
        hold = HoldLink(at.hold_port, token)
        return WebServer(desk, access, address=at.address, port=at.port, hold=hold)

    create = partial(ConsoleNode, HoldServer, make_page)
    return run_node(create, help_text=HELP, parameters=ConsoleParameters, spin=_spin)


def _spin(node: Node, end: EndRequest) -> int:
    assert isinstance(node, ConsoleNode)
    with executor_of(node) as executor:
        while not end.wanted:
            executor.spin_once(timeout_sec=_LOOK_PERIOD)
        node.close()
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
