"""The `peer_topics` executable: the component `PeerTopics` as a ROS node."""

from __future__ import annotations

import sys
from pathlib import Path

from needle_bags.live.peer_topics import PeerTopics, PeerTopicsParameters, read_peer_topics
from needle_core.files.installed import find_shared_file
from needle_core.ros.main import run_component

HELP = """
peer_topics: publishes the needle under the topic names, units and frames that other packages read,
and proposes their targets to the controller. It commands no motion.

Subscribes  needle/tip_pose, needle/estimate, needle/controller_status, target_plane, joint_states,
            device/joint_trajectory, targets of other packages
Publishes   needle/proposed_target, and the topics of `file` (docs/viewers.md)
"""


def main() -> int:
    """Run the node; return its exit code."""
    return run_component(PeerTopics.name, PeerTopicsParameters, _make, help_text=HELP)


def _make(settings: PeerTopicsParameters, _: str) -> PeerTopics:
    file = settings.file or find_shared_file("needle_bags", "config/peers.yaml")
    return PeerTopics(settings, read_peer_topics(Path(file)))


if __name__ == "__main__":
    sys.exit(main())
