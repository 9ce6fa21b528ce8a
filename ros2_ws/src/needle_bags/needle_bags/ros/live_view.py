"""The `live_view` executable: the component `LiveView` as a ROS node."""

from __future__ import annotations

import importlib.util
import sys

from needle_bags.live.live_view import LiveView, LiveViewParameters
from needle_core.ros.main import run_component

HELP = """
live_view: shows the needle to RViz, Foxglove and the like while it is steered. Each of its topics
is sent only while somebody subscribes to it; it moves nothing, and nothing waits for it.

Subscribes  needle/tip_pose, needle/estimate, needle/controller_status, target_plane, joint_states,
            stereo_tracker/calibration; stereo/{left,right}/image_raw (while its view is wanted)
Publishes   ~/tip, ~/path, ~/markers (shaft, tip, estimate, 95 % ellipsoid, plane, target point),
            ~/left/compressed, ~/right/compressed (JPEG, shaft and tip drawn in); /tf, /tf_static
            where tf2_msgs is installed
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
