"""The `openigtlink` executable: the steered needle for 3D Slicer and the like."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
import time

from rclpy.context import Context
from rclpy.parameter import Parameter

from needle_analysis.link.link_messages import packed
from needle_analysis.link.link_server import LinkServer
from needle_analysis.ros.needle_hearing import NeedleHearing
from needle_core.commands.cli import EXIT_BAD_INPUT
from needle_core.diagnostics import Diagnostic, Level
from needle_core.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher, run_node
from needle_core.ros.parameters import NodeParameters
from needle_core.ros.whole_node import WholeNode
from needle_core.settings.parameter_fields import check_fields, fixed_parameter

HELP = """
openigtlink: shows the needle to 3D Slicer and other OpenIGTLink clients, while one is connected.
It moves nothing, nothing waits for it, and what comes in at its port is discarded.

Subscribes  needle/tip_pose, needle/estimate, needle/controller_status, target_plane, joint_states
Sends       TRANSFORM NeedleTipToRig, NeedleEstimateToRig, TargetPlaneToRig; POINT NeedleShaft,
            NeedleTarget; STRING NeedleStatus; all in mm, in rig (docs/slicer.md)
"""
_PART = "listeners"


@dataclasses.dataclass(frozen=True)
class OpenIGTLinkParameters:
    """Parameters of openigtlink."""

    address: str = fixed_parameter(
        "127.0.0.1", "-", "Where it listens; beyond loopback all of that network can look on."
    )
    port: int = fixed_parameter(18944, "-", "Port that Slicer connects to; 0: any.", 0, 65535)
    rate: float = fixed_parameter(10.0, "Hz", "How often all is sent.", 0.5, 30.0)

    def __post_init__(self) -> None:
        """Check the fields; raises UserError as `check_fields`."""
        check_fields(self)


class OpenIGTLinkNode(WholeNode):
    """Says a `LiveNeedle` at a port.

    Parameters
    ----------
    context : Context, optional
        Where the node lives; the global context by default.
    parameter_overrides : list of Parameter, optional
        Parameters beside those of the command line.

    Attributes
    ----------
    server : LinkServer
        The port.
    """

    def __init__(
        self,
        context: Context | None = None,
        parameter_overrides: list[Parameter] | None = None,
    ) -> None:
        super().__init__("openigtlink", context=context, parameter_overrides=parameter_overrides)
        values = NodeParameters(self, OpenIGTLinkParameters).values
        self._diagnostics = DiagnosticsPublisher(self)
        self.server = LinkServer(values.address, values.port)
        hearing = NeedleHearing(self, self._diagnostics)
        self._needle = hearing.needle
        place = f"{values.address}, port {self.server.port}"
        self.get_logger().info(f"shows the needle at {place}")
        self.create_timer(1.0 / values.rate, self._show, clock=STEADY_CLOCK)

    def destroy_node(self) -> None:
        """Destroy the node, and close the port."""
        super().destroy_node()
        self.server.close()

    def _show(self) -> None:
        now = time.monotonic()
        self.server.turn(now)
        if self.server.listeners:
            stamp = self.get_clock().now().nanoseconds * 1e-9
            self.server.say(packed(self._needle, stamp), now)
        count = self.server.listeners
        keys = {"listeners": str(count), "turned away": str(self.server.turned_away)}
        line = f"{count} listening" if count else "nobody listens"
        self._diagnostics.set(_PART, Diagnostic(Level.OK, line, keys))


def main() -> int:
    """Run the node; returns its exit code."""
    if importlib.util.find_spec("pyigtl") is None:
        print(
            "error: pyigtl is not installed; docs/slicer.md says how to install it", file=sys.stderr
        )
        return EXIT_BAD_INPUT
    return run_node(OpenIGTLinkNode, help_text=HELP, parameters=OpenIGTLinkParameters)


if __name__ == "__main__":
    sys.exit(main())
