"""The `live_view` executable: the component `LiveView` as a ROS node, and its port."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Mapping

from needle_bags.live.live_view import FOXGLOVE, LiveView, LiveViewParameters
from needle_core.component import RealPort
from needle_core.errors import UserError
from needle_core.ros.main import run_component

HELP = """
live_view: publishes the needle for RViz, Foxglove and other viewers during steering. It publishes
a topic only while it has a subscriber, commands no motion, and never delays another node.

Subscribes  needle/tip_pose, needle/estimate, needle/controller_status, target_plane, joint_states,
            stereo_tracker/calibration; stereo/{left,right}/image_raw (only to publish its view)
Publishes   ~/tip, ~/path, ~/markers (shaft, tip, estimate, 95 % ellipsoid, plane, target point),
            ~/left/compressed, ~/right/compressed (JPEG with shaft and tip), robot_description;
            /tf, /tf_static (if tf2_msgs is installed)
Serves      all of these and what Foxglove plots, with -p foxglove_port:=8765 (docs/viewers.md)
"""


def main() -> int:
    """Run the node; return its exit code."""
    return run_component(LiveView.name, LiveViewParameters, _make, help_text=HELP, ports=_ports)


def _make(settings: LiveViewParameters, _: str) -> LiveView:
    # tf2_msgs is not on PyPI.
    transforms = importlib.util.find_spec("tf2_msgs") is not None
    if not transforms:
        print("live_view: no /tf, /tf_static: tf2_msgs is not installed", file=sys.stderr)
    return LiveView(settings, transforms=transforms)


def _ports(settings: LiveViewParameters) -> Mapping[str, RealPort]:
    if not settings.foxglove_port:
        return {}
    if importlib.util.find_spec("foxglove") is None:
        raise UserError("foxglove-sdk is not installed: see docs/viewers.md")
    from needle_bags.live.foxglove_port import FoxglovePort  # noqa: PLC0415

    channels = LiveView(settings, transforms=False).channels
    return {FOXGLOVE: FoxglovePort(settings.foxglove_port, channels)}


if __name__ == "__main__":
    sys.exit(main())
