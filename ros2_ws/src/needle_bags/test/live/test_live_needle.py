"""Drawing of a needle: shaft and path, estimate in `rig`, uncertainty, images with answers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from needle_bags.live.camera_images import LatestImages
from needle_bags.live.live_messages import SIGMAS, ellipsoid
from needle_bags.live.live_needle import LiveNeedle, MeasuredTip, TipEstimate
from needle_bags.run.shaft_trail import ShaftTrail
from needle_controller.model.target_plane import TargetPlane

RADIUS = 0.1
STEP = 1.1e-3
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


def arc(insertion: float) -> NDArray[np.float64]:
    """Tip positions of a needle on a circle."""
    angle = insertion / RADIUS
    return RADIUS * np.array([1.0 - np.cos(angle), 0.0, np.sin(angle)])


def inserted() -> ShaftTrail:
    trail = ShaftTrail()
    for insertion in np.arange(0.0, 0.0801, 1e-4):
        trail.add(insertion, arc(insertion))
    return trail


def test_the_shaft_follows_the_path_of_the_tip() -> None:
    shaft = inserted().shaft(0.08, arc(0.08))
    assert shaft[0] == pytest.approx(np.zeros(3))
    assert shaft[-1] == pytest.approx(arc(0.08))
    assert np.linalg.norm(shaft - [RADIUS, 0.0, 0.0], axis=1) == pytest.approx(RADIUS)
    assert np.linalg.norm(np.diff(shaft, axis=0), axis=1).sum() == pytest.approx(0.08, rel=1e-3)
    assert 70 < len(shaft) < 90


def test_a_withdrawn_needle_stays_on_its_path_until_it_is_out() -> None:
    trail = inserted()
    path = trail.path
    trail.add(0.03, arc(0.03))
    assert np.array_equal(trail.path, path)
    shaft = trail.shaft(0.03, arc(0.03))
    assert shaft[:, 2].max() == pytest.approx(arc(0.03)[2])
    assert 25 < len(shaft) < 32
    trail.add(0.0, arc(0.0))
    assert len(trail.path) == 1
    trail.add(0.002, -arc(0.002))
    assert trail.path[-1] == pytest.approx(-arc(0.002))


def test_the_ellipsoid_contains_95_percent() -> None:
    rng = np.random.default_rng(5)
    for turned in Rotation.random(4, random_state=5).as_matrix():
        covariance = turned @ np.diag([1e-8, 4e-8, 9e-6]) @ turned.T
        axes, lengths = ellipsoid(covariance)
        # A quaternion needs a right-handed frame.
        assert np.linalg.det(axes) == pytest.approx(1.0)
        drawn = rng.multivariate_normal(np.zeros(3), covariance, 20_000)
        inside = np.sum((drawn @ axes / lengths) ** 2, axis=1) <= 1.0
        assert inside.mean() == pytest.approx(0.95, abs=0.007)
        assert lengths.max() == pytest.approx(SIGMAS * 3e-3)


def test_the_estimate_is_transformed_to_the_rig() -> None:
    turned = Rotation.from_euler("xyz", [0.2, 0.1, -0.3]).as_matrix()
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = turned, [0.003, 0.001, 0.0]
    plane = TargetPlane(transform)
    needle: Any = LiveNeedle()
    heading = Rotation.from_euler("y", 0.1).as_matrix()
    covariance = np.diag([1.0, 2.0, 3.0]) * 1e-6
    needle.set_estimate(TipEstimate(np.array([0.001, 0.0, 0.05]), heading, covariance))
    assert [needle.estimate] == [None]
    needle.request_plane(plane)
    needle.set_targets(plane.offset, None)
    belief = needle.estimate
    assert plane.from_rig(belief.position) == pytest.approx(np.array([0.001, 0.0, 0.05]))
    assert belief.rotation == pytest.approx(turned @ heading)
    assert turned.T @ belief.covariance @ turned == pytest.approx(covariance)


def test_a_rejected_plane_is_ignored() -> None:
    needle: Any = LiveNeedle()
    assert [needle.plane] == [None]
    asked = np.eye(4)
    asked[0, 3] = 0.05
    needle.request_plane(TargetPlane(asked))
    needle.set_targets(0.003, np.array([0.01, 0.0, 0.1]))
    assert needle.plane.offset == pytest.approx(0.003)
    needle.set_targets(0.05, None)
    assert needle.plane.T_rig_plane[0, 3] == pytest.approx(0.05)
    assert needle.target_point is None


def pose(insertion: float) -> NDArray[np.float64]:
    """Pose of the tip on the circle."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("y", insertion / RADIUS).as_matrix()
    matrix[:3, 3] = arc(insertion)
    return matrix


def steered(insertion: float, *, estimated_to: float) -> Any:
    """Return a needle with measured tips 1 mm off the circle, and estimates on it."""
    needle: Any = LiveNeedle()
    needle.set_targets(0.0, None)
    for number in range(round(insertion / STEP) + 1):
        at = number * STEP
        needle.set_insertion(at)
        aside = arc(at) + np.array([0.0, 1e-3, 0.0])
        needle.add_tip(MeasuredTip(number, aside, UPRIGHT, np.eye(3)))
        if at <= estimated_to + 1e-9:
            rotation, position = pose(at)[:3, :3], arc(at)
            needle.set_estimate(TipEstimate(position, rotation, np.eye(3), number))
    return needle


def test_the_shape_follows_the_estimates() -> None:
    assert LiveNeedle().shape is None
    stamp, poses = steered(0.055, estimated_to=0.055).shape
    assert stamp == 50
    np.testing.assert_allclose(poses, [pose(number * STEP) for number in range(51)], atol=1e-12)


def test_the_end_of_a_withdrawn_needle_is_measured() -> None:
    needle = steered(0.055, estimated_to=0.055)
    needle.set_insertion(0.033)
    needle.add_tip(MeasuredTip(99, arc(0.033), UPRIGHT, np.eye(3)))
    stamp, poses = needle.shape
    assert stamp == 99
    np.testing.assert_allclose(poses[:-1], [pose(number * STEP) for number in range(30)], atol=1e-9)
    assert poses[-1, :3, 3] == pytest.approx(arc(0.033))
    # Neither an estimate nor a tip exists there: the shape is unknown.
    needle.add_missing_tip(100)
    assert needle.shape is None


def test_without_recent_estimates_the_shape_follows_the_measured_tips() -> None:
    for estimated_to in (-1.0, 0.04):
        stamp, poses = steered(0.055, estimated_to=estimated_to).shape
        assert stamp == 50
        assert poses[1:, 1, 3] == pytest.approx(1e-3)


def blank(value: int) -> NDArray[np.uint8]:
    return np.full((2, 2), value, np.uint8)


def test_an_image_is_shown_once_with_its_answer_or_late_without() -> None:
    images = LatestImages()

    def drawn(answered: int | None, now: float) -> tuple[int, bool] | None:
        found = images.next(answered, now)
        assert found is None or found[2][0, 0] == found[0]
        return None if found is None else found[:2]

    for stamp in (10, 20, 30):
        images.add(stamp, blank(stamp))
    assert drawn(None, 0.0) is None
    assert drawn(20, 0.1) == (20, True)
    assert drawn(20, 0.2) is None
    assert drawn(10, 0.2) is None
    assert drawn(30, 0.3) == (30, True)
    # Soon after the last image, the next ones still wait for an answer; then the newest is shown.
    for stamp in (40, 50):
        images.add(stamp, blank(stamp))
    assert drawn(30, 0.7) is None
    assert drawn(30, 0.9) == (50, False)
    assert drawn(30, 1.0) is None
