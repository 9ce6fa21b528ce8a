"""What a message on `target_point` does: a stamp says that the point may move."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PointStamped
from std_msgs.msg import Header

from needle_controller.model.target_motion import TargetMotion
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.ros.steering_messages import SteeringMessages

PLACE, DRIFT = np.array([0.004, 0.0, 0.09]), np.array([1e-4, 0.0, 0.0])


def motion_after(*, stamped: bool) -> TargetMotion:
    """Return what is known of a point that was seen to drift along x for 10 s."""
    messages = SteeringMessages(SteeringSettings())
    for k in range(41):
        seconds, nanoseconds = divmod(k * 250_000_000, 10**9)
        stamp = Time(sec=seconds + 5, nanosec=nanoseconds) if stamped else Time()
        x, y, z = PLACE + DRIFT * 0.25 * k
        header = Header(stamp=stamp, frame_id="rig")
        message = PointStamped(header=header, point=Point(x=float(x), y=float(y), z=float(z)))
        assert messages.inputs["target_point"].take(message, 0)
    points = messages.steering.control._points
    assert points is not None
    return points.motion


def test_a_stamped_point_is_foretold() -> None:
    np.testing.assert_allclose(motion_after(stamped=True).at(20.0), PLACE + DRIFT * 15.0, atol=1e-7)


def test_a_point_without_a_stamp_rests_where_it_was_put_last() -> None:
    np.testing.assert_allclose(
        motion_after(stamped=False).at(20.0), PLACE + DRIFT * 10.0, atol=1e-12
    )
