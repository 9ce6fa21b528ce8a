"""The `tracked_tip` executable."""

from __future__ import annotations

import sys
from collections.abc import Mapping

from needle_core.component import RealPort
from needle_core.ros.main import run_component
from needle_tracker import tracked_tip as node
from needle_tracker.tracked.transform_port import TransformPort

HELP = """
tracked_tip: publishes the needle's tip as an electromagnetic or optical tracker measures it.

Receives    OpenIGTLink TRANSFORM (of PlusServer: in mm), tracker/pose (PoseStamped) or
            tracker/transform (TransformStamped); joint_states
Publishes   needle/tip, needle/tip_pose, /diagnostics (counts of what is no tip, by fault)

`ros2 run needle_tracker register_tracker` writes registration_file. While another node publishes
needle/tip, this one publishes none.
"""


def ports(settings: node.TrackedTipParameters) -> Mapping[str, RealPort]:
    """Return the connection to the tracker, unless the source is a topic."""
    if settings.source in (node.POSE, node.TRANSFORM):
        return {}
    return {node.TRACKER: TransformPort(settings.address, listens=settings.source == node.SERVER)}


def main() -> int:
    """Run the node; returns its exit code."""
    return run_component(
        node.TrackedTip.name,
        node.TrackedTipParameters,
        node.make_tracked_tip,
        help_text=HELP,
        ports=ports,
    )


if __name__ == "__main__":
    sys.exit(main())
