"""Sends bad data into a running graph, for the checks that nothing moves from it."""

from __future__ import annotations

import array
import dataclasses
import itertools
import math
import sys

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PointStamped
from sensor_msgs.msg import Image, JointState

from needle_common.errors import UserError
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


@dataclasses.dataclass(frozen=True)
class BadInputParameters:
    """Parameters of the publisher."""

    kinds: tuple[str, ...] = fixed_parameter(
        ("not_finite",), "-", "What is bad; several take turns.", choices=(*TIPS, LEFT_IMAGE)
    )
    every: int = fixed_parameter(
        40, "-", "Joint states from one bad message to the next.", 1, 10000
    )

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.kinds:
            raise UserError("kinds is empty")


class BadInput(WholeNode):
    """Answers every so many joint states with a bad tip or a left image alone."""

    def __init__(self) -> None:
        super().__init__("bad_input")
        values = NodeParameters(self, BadInputParameters).values
        self._every = values.every
        self._turns = itertools.cycle(values.kinds)
        self._seen = 0
        images = LEFT_IMAGE in values.kinds
        self._left = (
            self.create_publisher(Image, "stereo/left/image_raw", IMAGES) if images else None
        )
        self._tip = (
            self.create_publisher(PointStamped, "needle/tip", RELIABLE)
            if set(values.kinds) & set(TIPS)
            else None
        )
        self.create_subscription(JointState, "joint_states", self._on_joints, JOINT_STATES)

    def _on_joints(self, message: JointState) -> None:
        self._seen += 1
        if self._seen % self._every:
            return
        kind = next(self._turns)
        if kind == LEFT_IMAGE and self._left is not None:
            self._left.publish(_image(message.header.stamp))
        elif self._tip is not None:
            self._tip.publish(_tip(kind, message.header.stamp, float(message.position[0])))


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
