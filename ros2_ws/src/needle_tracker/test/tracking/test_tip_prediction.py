"""The filter over the insertion."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from needle_tracker.tracking.tip_prediction import TipMotion
from needle_tracker.tracking.triangulation import SpatialTip

CURVATURE = 8.0


def measured(position: np.ndarray, sigma: np.ndarray, direction: np.ndarray) -> SpatialTip:
    return SpatialTip(position, np.diag(sigma**2), direction, np.eye(3) * 1e-4, 0.0, 0.0)


def way(mm: float) -> tuple[np.ndarray, np.ndarray]:
    turn = CURVATURE * mm * 1e-3
    place = np.array([(1 - np.cos(turn)) / CURVATURE, 0.0, np.sin(turn) / CURVATURE])
    return place, np.array([np.sin(turn), 0.0, np.cos(turn)])


def test_a_bent_way_is_predicted_within_its_covariance() -> None:
    rng = np.random.default_rng(5)
    sigma = np.array([0.05e-3, 0.01e-3, 0.01e-3])
    surprises = []
    for _ in range(60):
        # The visible end leans off the heading.
        lean = np.array([0.08, 0.05, 0.0])
        motion = None
        for mm in range(20, 50):
            place, heading = way(mm)
            seen = (heading + lean) / np.linalg.norm(heading + lean)
            tip = measured(place + rng.normal(0.0, sigma), sigma, seen)
            if motion is None:
                motion = TipMotion.start(tip)
                continue
            motion = motion.advanced(1e-3, CURVATURE)
            surprises.append(motion.surprise(tip))
            motion = motion.updated(tip)
        assert motion is not None
        np.testing.assert_allclose(motion.heading, way(49)[1], atol=0.05)
    assert np.mean(np.array(surprises) < chi2.ppf(0.95, 3)) > 0.93


def test_a_spoilt_view_moves_the_tip_less_than_a_clear_one() -> None:
    start = measured(np.zeros(3), np.full(3, 1e-5), np.array([0.0, 0.0, 1.0]))
    motion = TipMotion.start(start).advanced(1e-3, CURVATURE)
    off = np.array([0.4e-3, 0.0, 1e-3])
    moved = [
        motion.updated(measured(off, np.array([sigma, 1e-5, 1e-5]), start.direction)).position[0]
        for sigma in (1e-5, 1e-3)
    ]
    assert moved[0] > 0.35e-3
    assert moved[1] < 0.1e-3


def test_a_surprise_leaves_open_which_of_the_two_is_wrong() -> None:
    start = measured(np.zeros(3), np.full(3, 2e-5), np.array([0.0, 0.0, 1.0]))
    motion = TipMotion.start(start).advanced(1e-3, CURVATURE)
    for off in (0.5e-3, 1e-3, 3e-3):
        tip = measured(np.array([off, 0.0, 1e-3]), np.full(3, 5e-5), start.direction)
        merged = motion.merged(tip)
        for truth in (motion.position, tip.position):
            error = merged.position - truth
            assert error @ np.linalg.solve(merged.covariance, error) < 9.0
    near = measured(np.array([0.05e-3, 0.0, 1e-3]), np.full(3, 5e-5), start.direction)
    assert motion.merged(near).covariance[0, 0] < 2.0 * 5e-5**2


def test_drawn_back_it_goes_back() -> None:
    start = measured(np.array([0.0, 0.0, 0.05]), np.full(3, 1e-5), np.array([0.0, 0.0, 1.0]))
    back = TipMotion.start(start).advanced(-2e-3, CURVATURE)
    np.testing.assert_allclose(back.position, [0.0, 0.0, 0.048])


def test_one_direction_taken_in_says_nothing_of_the_others() -> None:
    start = measured(np.zeros(3), np.full(3, 2e-5), np.array([0.0, 0.0, 1.0]))
    motion = TipMotion.start(start).advanced(5e-3, CURVATURE)
    slope = np.array([[0.0, 3.0, 0.0]])
    taken = motion.taken_in(np.array([1e-4]), slope, np.array([[1e-12]]))
    assert taken.position[1] - motion.position[1] == pytest.approx(1e-4 / 3.0, rel=0.01)
    np.testing.assert_allclose(taken.position[[0, 2]], motion.position[[0, 2]], atol=1e-12)
    before, after = np.diag(motion.covariance), np.diag(taken.covariance)
    np.testing.assert_allclose(after[[0, 2]], before[[0, 2]], rtol=1e-9)
    assert after[1] < 0.01 * before[1]
    # The heading follows where the tip turned out to be.
    assert taken.heading[1] > motion.heading[1]
    assert after[4] < before[4]


def test_the_stage_says_how_fast_the_needle_goes() -> None:
    """Ends that are seen too far along it, time after time, do not make it go faster."""
    start = measured(np.zeros(3), np.full(3, 2e-5), np.array([0.0, 0.0, 1.0]))
    motion = TipMotion.start(start)
    for number in range(1, 6):
        motion = motion.advanced(1e-3, CURVATURE)
        motion = motion.updated(
            measured(
                np.array([number * 0.2e-3, 0.0, number * 1.3e-3]), np.full(3, 1e-4), start.direction
            )
        )
    assert motion.heading[0] > 0.1
    way = motion.advanced(4e-3, CURVATURE).position - motion.position
    assert np.linalg.norm(way) == pytest.approx(4e-3, rel=1e-12)


def test_what_shifts_every_end_along_the_needle_does_not_average_out() -> None:
    """A bevel, blur or light is the same in the next pair; noise across is not."""
    rng, sigma = np.random.default_rng(8), np.array([1e-4, 1e-4, 1e-4])
    heading, shift = np.array([0.0, 0.0, 1.0]), 1.5e-4
    motion = TipMotion.start(measured(np.array([0.0, 0.0, shift]), sigma, heading))
    for number in range(1, 31):
        noise = np.array([*rng.normal(0.0, sigma[:2]), shift])
        motion = motion.advanced(1e-3, CURVATURE)
        motion = motion.updated(measured(number * 1e-3 * heading + noise, sigma, heading))
    known = np.sqrt(np.diag(motion.covariance)[:3])
    assert known[2] > 0.9 * sigma[2]
    assert max(known[:2]) < 0.8 * sigma[0]


def test_how_far_the_needle_goes_is_not_in_doubt() -> None:
    start = measured(np.zeros(3), np.full(3, 2e-5), np.array([0.6, 0.0, 0.8]))
    motion = TipMotion.start(start).advanced(5e-3, CURVATURE)
    heading = motion.covariance[3:, 3:]
    np.testing.assert_allclose(heading @ start.direction, 0.0, atol=1e-12)
    assert np.linalg.matrix_rank(heading, tol=1e-6) == 2


def test_the_largest_sigma_is_that_of_the_worst_direction() -> None:
    sigmas = np.array([1e-5, 4e-5, 2e-5])
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    tip = SpatialTip(np.zeros(3), turn @ np.diag(sigmas**2) @ turn.T, turn[2], np.eye(3), 0.0, 0.0)
    assert TipMotion.start(tip).sigma == pytest.approx(4e-5)


def test_a_needle_out_of_sight_may_bend_the_same_way_all_along() -> None:
    start = measured(np.zeros(3), np.full(3, 1e-5), np.array([0.0, 0.0, 1.0]))
    at_once = TipMotion.start(start).advanced(12e-3, CURVATURE)
    motion, way = TipMotion.start(start), 0.0
    for _ in range(12):
        motion, way = motion.advanced(1e-3, CURVATURE, way), way + 1e-3
    np.testing.assert_allclose(motion.covariance[3:, 3:], at_once.covariance[3:, 3:], rtol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 0.05, 0.3, 1.0])
def test_a_direction_surprises_by_its_angle_over_all_that_is_unknown(angle: float) -> None:
    motion = TipMotion(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.diag([1e-8] * 3 + [0.05**2] * 3))
    # The heading's covariance, the measured one's, and what the visible end leans off the heading.
    unknown = 0.05**2 + 1e-4 + 0.12**2
    for around in (0.0, 2.0, 4.0):
        side = np.sin(angle) * np.array([np.cos(around), np.sin(around)])
        tip = measured(np.zeros(3), np.full(3, 1e-5), np.array([*side, np.cos(angle)]))
        assert motion.direction_surprise(tip) == pytest.approx(np.sin(angle) ** 2 / unknown)
    backwards = measured(np.zeros(3), np.full(3, 1e-5), np.array([0.0, 0.0, -1.0]))
    assert motion.direction_surprise(backwards) == np.inf
