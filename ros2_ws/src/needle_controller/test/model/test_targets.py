"""Planes in `rig`, and prediction of targets that drift, breathe, jump or rest."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_controller.model.arrays import Array
from needle_controller.model.reachability import check_plane
from needle_controller.model.target_motion import SHORTEST, TargetMotion
from needle_controller.model.target_plane import offset_plane, plane_from_pose
from needle_core.errors import UserError

PLACE = np.array([0.004, -0.006, 0.09])
DRIFT = np.array([3e-5, -2e-5, 1e-5])  # [m/s]
BREATH = np.array([0.002, 0.001, -0.002])
Path = Callable[[float], Array]


def observed(path: Path, end: float, every: float = 0.25, begin: float = 0.0) -> TargetMotion:
    motion = TargetMotion()
    for time in np.arange(0.0, end + 1e-9, every):
        motion.observe(begin + float(time), path(float(time)))
    return motion


def sine(rate: float) -> Path:
    return lambda t: PLACE + DRIFT * t + BREATH * np.sin(2.0 * np.pi * rate * t + 0.7)


def chest(rate: float) -> Path:
    """Return a breath that rests after exhalation, as a sleeper's does."""
    return lambda t: PLACE + DRIFT * t + 2.0 * BREATH * np.cos(np.pi * rate * t) ** 4


def drift(t: float) -> Array:
    return np.asarray(PLACE + DRIFT * t)


def test_a_general_pose_is_a_rigid_transform() -> None:
    np.testing.assert_allclose(offset_plane(0.003).from_rig([0.0, 0.0, 0.0]), [-0.003, 0.0, 0.0])
    rotation, origin = Rotation.from_euler("xyz", [0.3, -0.4, 0.5]), np.array([0.001, -0.02, 0.03])
    plane = plane_from_pose("rig", origin, rotation.as_quat())
    np.testing.assert_allclose(plane.T_rig_plane[:3, :3], rotation.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(plane.T_plane_rig @ plane.T_rig_plane, np.eye(4), atol=1e-12)
    points = np.arange(12.0).reshape(2, 2, 3)
    np.testing.assert_allclose(
        plane.from_rig(points).reshape(-1, 3),
        rotation.inv().apply((points - origin).reshape(-1, 3)),
    )
    # The distance of the entry from the plane does not depend on where in the plane its origin is.
    moved = plane_from_pose("rig", origin + rotation.apply([0.0, 0.05, -0.02]), rotation.as_quat())
    assert moved.offset == pytest.approx(plane.offset)


def test_unreachable_planes_are_rejected() -> None:
    unit, half = [0.0, 0.0, 0.0, 1.0], np.sqrt(0.5)
    rows: list[tuple[str, list[float], list[float], str]] = [
        ("left_camera_optical", [0.0] * 3, unit, "left_camera_optical"),
        ("rig", [np.nan, 0.0, 0.0], unit, "not finite"),
        ("rig", [0.0] * 3, [0.0, 0.0, np.inf, 1.0], "not finite"),
        ("rig", [0.0] * 3, [0.0, 0.0, 0.0, 2.0], "length 2"),
        ("rig", [0.0] * 3, [0.0, half, 0.0, half], "90 deg"),
    ]
    for frame, position, quaternion, cause in rows:
        with pytest.raises(UserError, match=cause):
            plane_from_pose(frame, position, quaternion)
    for offset, depth in ((-0.05, 0.12), (3.0, 0.12), (0.05, 0.15)):
        with pytest.raises(UserError, match=r"cannot be reached.* takes .* m of insertion"):
            check_plane(offset_plane(offset), 1 / 0.122, depth)
    steep = plane_from_pose("rig", [0.0] * 3, [0.0, np.sin(0.6), 0.0, np.cos(0.6)])
    with pytest.raises(UserError, match="cannot be reached"):
        check_plane(steep, 1 / 0.122, 0.12)
    # A smaller depth is checked as SHORTEST_CHECKED_DEPTH.
    for offset, depth in ((0.02, 0.12), (0.02, 0.01), (0.05, 0.19)):
        check_plane(offset_plane(offset), 1 / 0.122, depth)


def test_a_target_at_rest_or_hardly_observed_is_predicted_exactly_at_its_last_position() -> None:
    for motion in (
        observed(lambda _: PLACE, 0.0),
        observed(lambda _: PLACE, 30.0),
        observed(sine(0.2), SHORTEST - 0.25),
    ):
        np.testing.assert_array_equal(motion.at(60.0), motion.last)
    walk = np.cumsum(np.random.default_rng(4).normal(0.0, 1e-3, (200, 3)), axis=0)
    walking = observed(lambda t: np.asarray(PLACE + walk[round(t / 0.25)]), 25.0)
    np.testing.assert_allclose(walking.at(60.0), walking.last, atol=1e-5)


def test_the_prediction_restarts_when_time_is_set_back() -> None:
    motion = observed(sine(0.2), 25.0)
    for time in np.arange(3.0, 13.0, 0.25):
        motion.observe(float(time), drift(float(time)))
    np.testing.assert_allclose(motion.at(15.0), drift(15.0), atol=1e-4)


def test_a_motion_is_predicted_for_any_shape_and_clock() -> None:
    for path, begin in itertools.product((drift, sine(0.12), sine(0.33), chest(0.2)), (0.0, 1.7e9)):
        motion = observed(path, 25.0, begin=begin)
        for time in (26.0, 30.0, 35.0):
            np.testing.assert_allclose(motion.at(begin + time), path(time), atol=1e-4)


def test_a_fast_drift_is_predicted_after_three_seconds() -> None:
    path: Path = lambda t: PLACE + 30.0 * DRIFT * t  # noqa: E731
    np.testing.assert_allclose(observed(path, 3.0).at(50.0), path(50.0), atol=1e-3)
    # A breath that resembles a drift for so long is not followed far away.
    for rate in (0.1, 0.15, 0.2, 0.33):
        away = observed(sine(rate), 3.0).at(50.0) - PLACE
        assert np.linalg.norm(away) < 0.015


def test_noise_is_averaged() -> None:
    rng, path, errors = np.random.default_rng(2), sine(0.2), []
    for _ in range(10):
        motion = observed(lambda t: path(t) + rng.normal(0.0, 3e-4, 3), 25.0, every=0.1)
        errors.append(motion.at(30.0) - path(30.0))
    # as good as one sample alone, which is 0.3 mm
    assert np.sqrt(np.mean(np.square(errors))) < 2e-4


def test_after_a_jump_a_target_breathes_about_its_new_position() -> None:
    calm = sine(0.2)
    path: Path = lambda t: calm(t) + (0.003 if t > 20.0 else 0.0)  # noqa: E731
    assert np.linalg.norm(observed(path, 20.5).last - path(20.5)) == 0.0
    np.testing.assert_allclose(observed(path, 32.0).at(36.0), path(36.0), atol=1e-4)


def test_a_fast_topic_takes_no_more_memory_than_a_slow_one() -> None:
    fast, slow = observed(sine(0.2), 25.0, every=0.01), observed(sine(0.2), 25.0)
    assert len(fast._times) <= 1.1 * len(slow._times)
    np.testing.assert_allclose(fast.at(30.0), sine(0.2)(30.0), atol=1e-4)


def test_no_target_is_predicted_far_from_its_observed_positions() -> None:
    """Samples at odd times can leave a period nearly undetermined: its prediction is then noise."""
    rng = np.random.default_rng(6)
    for _ in range(60):
        times = np.sort(rng.uniform(0.0, 8.0, rng.integers(7, 12)))
        motion, points = TargetMotion(), []
        for time in times:
            points.append(PLACE + rng.normal(0.0, 1e-3, 3))
            motion.observe(float(time), points[-1])
        extent = np.ptp(points, axis=0)
        ahead = np.array([motion.at(float(times[-1]) + t) for t in (0.5, 3.0, 30.0)])
        assert np.all(ahead <= np.max(points, axis=0) + 2.0 * extent + 1e-12)
        assert np.all(ahead >= np.min(points, axis=0) - 2.0 * extent - 1e-12)
