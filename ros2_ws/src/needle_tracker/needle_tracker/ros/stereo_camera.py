"""The `stereo_camera` executable."""

from __future__ import annotations

import sys

from needle_core.ros.main import run_component
from needle_tracker.stereo_camera import PAIRS, StereoCameraParameters, make_camera, open_pairs

HELP = """
stereo_camera: publishes image pairs of two V4L2/UVC cameras, image folders or video files.

  ros2 run needle_tracker stereo_camera --ros-args -p left:=/dev/video0 -p right:=/dev/video2
  ros2 run needle_tracker stereo_camera --ros-args -p left:=images/left -p right:=images/right

Publishes   stereo/{left,right}/image_raw (mono8), stereo/{left,right}/camera_info, /diagnostics

Both cameras are grabbed before either image is decoded; the stamp is the time of the grab minus
`latency`. A camera number needs two levels of quotes: -p "left:='0'".
Exit codes: 0 ended by a signal or at the end of the recording; 2 a camera, folder or file is
missing, or an image size is wrong
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
