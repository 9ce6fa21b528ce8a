"""The `live_view` executable: the component `LiveView` as a ROS node."""

from __future__ import annotations

import importlib.util
import sys

from needle_bags.live.live_view import LiveView, LiveViewParameters
from needle_core.ros.main import run_component

HELP = """
live_view: publishes the needle for RViz, Foxglove and other viewers during steering. It publishes
a topic only while it has a subscriber, commands no motion, and never delays another node.

Subscribes  needle/tip_pose, needle/estimate, needle/controller_status, target_plane, joint_states,
            stereo_tracker/calibration; stereo/{left,right}/image_raw (only to publish its view)
Publishes   ~/tip, ~/path, ~/markers (shaft, tip, estimate, 95 % ellipsoid, plane, target point),
            ~/left/compressed, ~/right/compressed (JPEG with shaft and tip); /tf, /tf_static (if
            tf2_msgs is installed)
"""


def main() -> int:
    """Run the node; returns its exit code."""
    # No wheel on PyPI brings it.
    transforms = importlib.util.find_spec("tf2_msgs") is not None
    return run_component(
        LiveView.name,
        LiveViewParameters,
        lambda settings, _: LiveView(settings, transforms=transforms),
        help_text=HELP,
    )


if __name__ == "__main__":
    sys.exit(main())
