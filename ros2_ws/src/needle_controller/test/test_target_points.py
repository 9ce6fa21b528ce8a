"""What a message on `target_point` does: a stamp says that the point may move."""

import numpy as np

from needle_controller.model.target_motion import TargetMotion
from needle_controller.plane_controller import PlaneController
from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.component import Moment
from needle_core.messages import Point

PLACE, DRIFT = np.array([0.004, 0.0, 0.09]), np.array([1e-4, 0.0, 0.0])


def motion_after(*, stamped: bool) -> TargetMotion:
    """Return what is known of a point that was seen to drift along x for 10 s."""
    controller = PlaneController(SteeringSettings())
    (row,) = [row for row in controller.inputs if row.topic == "target_point"]
    for k in range(41):
        stamp_ns = k * 250_000_000 + 5_000_000_000 if stamped else 0
        x, y, z = PLACE + DRIFT * 0.25 * k
        list(row.handler(Point(stamp_ns, "rig", (x, y, z)), Moment(0.25 * k, stamp_ns)))
    points = controller.steering.control._points
    assert points is not None
    return points.motion


def test_a_stamped_point_is_foretold() -> None:
    np.testing.assert_allclose(motion_after(stamped=True).at(20.0), PLACE + DRIFT * 15.0, atol=1e-7)


def test_a_point_without_a_stamp_rests_where_it_was_put_last() -> None:
    np.testing.assert_allclose(
        motion_after(stamped=False).at(20.0), PLACE + DRIFT * 10.0, atol=1e-12
    )
