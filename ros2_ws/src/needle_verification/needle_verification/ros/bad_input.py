"""Sends bad data into a running graph, for the checks that nothing moves from it."""

from __future__ import annotations

import array
import dataclasses
import math
import sys

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PointStamped
from sensor_msgs.msg import Image, JointState

from needle_common.ros.base_node import run_node
from needle_common.ros.conversions import IMAGES, JOINT_STATES, RELIABLE, to_nanoseconds, to_stamp
from needle_common.ros.parameters import NodeParameters
from needle_common.ros.whole_node import WholeNode
from needle_common.settings.parameter_fields import check_fields, fixed_parameter

HELP = """\
bad_input: publishes bad tips or lonely images beside the good ones, stamped like joint_states.
"""
TIPS = ("not_finite", "frame", "millimetres")
LEFT_IMAGE = "left_image"
# Joint states from one bad message to the next.
_EVERY = 40


@dataclasses.dataclass(frozen=True)
class BadInputParameters:
    """Parameters of the publisher."""

    kind: str = fixed_parameter("not_finite", "-", "What is bad.", choices=(*TIPS, LEFT_IMAGE))

    def __post_init__(self) -> None:
        check_fields(self)


class BadInput(WholeNode):
    """Answers every so many joint states with a bad tip or a left image alone."""

    def __init__(self) -> None:
        super().__init__("bad_input")
        self._kind = NodeParameters(self, BadInputParameters).values.kind
        self._seen = 0
        self._bad = (
            self.create_publisher(Image, "stereo/left/image_raw", IMAGES)
            if self._kind == LEFT_IMAGE
            else self.create_publisher(PointStamped, "needle/tip", RELIABLE)
        )
        self.create_subscription(JointState, "joint_states", self._on_joints, JOINT_STATES)

    def _on_joints(self, message: JointState) -> None:
        self._seen += 1
        if self._seen % _EVERY:
            return
        stamp, insertion = message.header.stamp, float(message.position[0])
        self._bad.publish(
            _image(stamp) if self._kind == LEFT_IMAGE else _tip(self._kind, stamp, insertion)
        )


def _tip(kind: str, stamp: Time, insertion: float) -> PointStamped:
    message = PointStamped()
    message.header.stamp = stamp
    message.header.frame_id = "left_camera_optical" if kind == "frame" else "rig"
    scale = 1000.0 if kind == "millimetres" else 1.0
    message.point.x = math.nan if kind == "not_finite" else 0.001 * scale
    message.point.z = max(insertion, 0.005) * scale
    return message


def _image(stamp: Time) -> Image:
    message = Image(height=768, width=1024, encoding="mono8", step=1024)
    # between two exposures: it must not find a partner
    message.header.stamp = to_stamp(to_nanoseconds(stamp) - 7_000_000)
    message.header.frame_id = "left_camera_optical"
    message.data = array.array("B", bytes(1024 * 768))
    return message


def main() -> int:
    """Run the node; returns its exit code."""
    return run_node(BadInput, help_text=HELP, parameters=BadInputParameters)


if __name__ == "__main__":
    sys.exit(main())
