"""The `stereo_camera` executable."""

from __future__ import annotations

import sys

from needle_core.ros.main import run_component
from needle_tracker.stereo_camera import PAIRS, StereoCameraParameters, make_camera, open_pairs

HELP = """
stereo_camera: image pairs from two V4L2/UVC cameras, two folders or two video files.

  ros2 run needle_tracker stereo_camera --ros-args -p left:=/dev/video0 -p right:=/dev/video2
  ros2 run needle_tracker stereo_camera --ros-args -p left:=images/left -p right:=images/right

Publishes: stereo/{left,right}/image_raw (mono8), stereo/{left,right}/camera_info, /diagnostics.
Both cameras are grabbed first, then decoded; the stamp is the time of the grab less `latency`.
A camera by its number needs quotes within quotes: -p "left:='0'".
Exit codes: 0 ended by a signal or at the end of the recording; 2 a camera, folder, file or size
that is missing or wrong.
"""


def main() -> int:
    """Run the node; returns its exit code."""
    return run_component(
        "stereo_camera",
        StereoCameraParameters,
        make_camera,
        help_text=HELP,
        ports=lambda settings: {PAIRS: open_pairs(settings)},
    )


if __name__ == "__main__":
    sys.exit(main())
