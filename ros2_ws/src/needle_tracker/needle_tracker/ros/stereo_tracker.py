"""The `stereo_tracker` executable."""

from __future__ import annotations

import sys

from needle_core.ros.main import run_component
from needle_tracker.stereo_tracker import make_tracker
from needle_tracker.tracker_parameters import StereoTrackerParameters

HELP = """
stereo_tracker: measures the needle's tip in stereo images through the phantom's surface.

Subscribes  stereo/{left,right}/image_raw, stereo/{left,right}/camera_info, joint_states
Publishes   needle/tip (only if a tip was found), needle/tip_pose (one per image pair; an infinite
            covariance means that no tip was found), /diagnostics, ~/calibration (text of the
            calibration file, latched), ~/annotated_image (only while it has a subscriber)
"""


def main() -> int:
    """Run the node; returns its exit code."""
    return run_component("stereo_tracker", StereoTrackerParameters, make_tracker, help_text=HELP)


if __name__ == "__main__":
    sys.exit(main())
