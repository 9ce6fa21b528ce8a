"""The `openigtlink` executable: the component `OpenIGTLink` as a ROS node, and its port."""

from __future__ import annotations

import importlib.util
import sys

from needle_bags.link.link_port import LinkPort
from needle_bags.link.openigtlink import LINK, OpenIGTLink, OpenIGTLinkParameters
from needle_core.commands.cli import EXIT_BAD_INPUT
from needle_core.ros.main import run_component

HELP = """
openigtlink: sends the needle to 3D Slicer and other OpenIGTLink clients, and proposes the targets
that they send to the controller. It commands no motion and never delays another node.

Subscribes  needle/tip_pose, needle/estimate, needle/planned_path, needle/controller_status,
            target_plane, joint_states
Publishes   needle/proposed_target
Sends       TRANSFORM NeedleTipToRig, NeedleEstimateToRig, TargetPlaneToRig; POINT NeedleShaft,
            NeedleTarget; POLYDATA NeedleShape, NeedlePlan; STRING NeedleStatus
Receives    POINT with names target..., entry..., or entry and target in one message named so;
            all in mm, in rig (docs/viewers.md)
"""


def main() -> int:
    """Run the node; return its exit code."""
    if importlib.util.find_spec("pyigtl") is None:
        print(
            "error: pyigtl is not installed: see docs/viewers.md",
            file=sys.stderr,
        )
        return EXIT_BAD_INPUT
    return run_component(
        OpenIGTLink.name,
        OpenIGTLinkParameters,
        lambda settings, _: OpenIGTLink(settings),
        help_text=HELP,
        ports=lambda settings: {LINK: LinkPort(settings.address, settings.port)},
    )


if __name__ == "__main__":
    sys.exit(main())
