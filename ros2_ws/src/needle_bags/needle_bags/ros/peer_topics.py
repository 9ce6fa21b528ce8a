"""The `peer_topics` executable: the component `PeerTopics` as a ROS node."""

from __future__ import annotations

import sys
from pathlib import Path

from needle_bags.live.peer_topics import PeerTopic, PeerTopics, PeerTopicsParameters, peer_table
from needle_core.errors import UserError
from needle_core.files.installed import find_shared_file
from needle_core.files.yaml_files import read_yaml
from needle_core.ros.main import run_component

HELP = """
peer_topics: publishes the needle under the topic names, units and frames that other packages read,
and proposes their targets to the controller. A file lists the topics. It commands no motion.

Subscribes  needle/tip_pose, needle/estimate, needle/controller_status, target_plane, joint_states,
            device/joint_trajectory; targets of other packages (by default /subject/state/target)
Publishes   needle/proposed_target; by default needle/shape, /needle/state/current_shape,
            /needle/state/skin_entry, /stage/state/needle_pose, needle/measured_js,
            needle/measured_cp, needle/setpoint_js
"""


def main() -> int:
    """Run the node; returns its exit code."""
    return run_component(
        PeerTopics.name,
        PeerTopicsParameters,
        lambda settings, _: PeerTopics(settings, _table(settings.file)),
        help_text=HELP,
    )


def _table(file: str) -> tuple[PeerTopic, ...]:
    path = Path(file) if file else find_shared_file("needle_bags", "config/peers.yaml")
    try:
        return peer_table(read_yaml(path))
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


if __name__ == "__main__":
    sys.exit(main())
