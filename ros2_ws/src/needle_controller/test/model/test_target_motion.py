"""A target that drifts, breathes, jumps, or rests: where it is expected, against where it is."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from needle_controller.model.arrays import Array
from needle_controller.model.target_motion import SHORTEST, TargetMotion

PLACE = np.array([0.004, -0.006, 0.09])
DRIFT = np.array([3e-5, -2e-5, 1e-5])  # [m/s]
BREATH = np.array([0.002, 0.001, -0.002])
Path = Callable[[float], Array]


def seen(path: Path, end: float, every: float = 0.25, begin: float = 0.0) -> TargetMotion:
    motion = TargetMotion()
    for time in np.arange(begin, end + 1e-9, every):
        motion.see(float(time), path(float(time)))
    return motion


def sine(rate: float) -> Path:
    return lambda t: PLACE + DRIFT * t + BREATH * np.sin(2.0 * np.pi * rate * t + 0.7)


def chest(rate: float) -> Path:
    """Return a breath that rests when it is out, as a sleeper's does."""
    return lambda t: PLACE + DRIFT * t + 2.0 * BREATH * np.cos(np.pi * rate * t) ** 4


def test_what_was_seen_once_is_there() -> None:
    motion = TargetMotion()
    motion.see(3.0, PLACE)
    np.testing.assert_array_equal(motion.at(50.0), PLACE)


def test_what_rests_is_where_it_is_to_the_bit() -> None:
    motion = seen(lambda _: PLACE, 30.0)
    np.testing.assert_array_equal(motion.at(60.0), PLACE)


def test_a_drift_goes_on() -> None:
    path: Path = lambda t: PLACE + DRIFT * t  # noqa: E731
    np.testing.assert_allclose(seen(path, 10.0).at(20.0), path(20.0), atol=1e-9)


@pytest.mark.parametrize("breath", [sine, chest])
@pytest.mark.parametrize("rate", [0.12, 0.2, 0.27, 0.33])
def test_a_breath_is_foretold_whatever_its_rate_and_shape(
    breath: Callable[[float], Path], rate: float
) -> None:
    path = breath(rate)
    motion = seen(path, 25.0)
    for time in (26.0, 28.0, 30.0, 35.0):
        np.testing.assert_allclose(motion.at(time), path(time), atol=1e-4)


@pytest.mark.parametrize("begin", [0.0, 1.7e9])
def test_the_clock_may_begin_anywhere(begin: float) -> None:
    path = sine(0.2)
    motion = TargetMotion()
    for time in np.arange(0.0, 25.0, 0.25):
        motion.see(begin + float(time), path(float(time)))
    np.testing.assert_allclose(motion.at(begin + 30.0), path(30.0), atol=1e-4)


def test_noise_is_averaged() -> None:
    rng = np.random.default_rng(2)
    path = sine(0.2)
    errors = []
    for _ in range(20):
        motion = seen(lambda t: path(t) + rng.normal(0.0, 3e-4, 3), 25.0, every=0.1)
        errors.append(motion.at(30.0) - path(30.0))
    # as good as one sample alone, which is 0.3 mm
    assert np.sqrt(np.mean(np.square(errors))) < 2e-4


def test_after_a_jump_it_is_where_it_was_seen_and_breathes_on() -> None:
    calm = sine(0.2)
    path: Path = lambda t: calm(t) + (0.003 if t > 20.0 else 0.0)  # noqa: E731
    just_after = seen(path, 20.5)
    assert np.linalg.norm(just_after.last - path(20.5)) == 0.0
    settled = seen(path, 32.0)
    np.testing.assert_allclose(settled.at(36.0), path(36.0), atol=1e-4)


def test_nothing_is_foretold_far_from_where_it_was_seen() -> None:
    """Samples at odd times can leave a period nearly free: what it says of later is then noise."""
    rng = np.random.default_rng(6)
    for _ in range(300):
        times = np.sort(rng.uniform(0.0, 8.0, rng.integers(7, 12)))
        motion, points = TargetMotion(), []
        for time in times:
            points.append(PLACE + rng.normal(0.0, 1e-3, 3))
            motion.see(float(time), points[-1])
        extent = np.ptp(points, axis=0)
        ahead = np.array([motion.at(float(times[-1]) + t) for t in (0.5, 3.0, 30.0)])
        assert np.all(ahead <= np.max(points, axis=0) + 2.0 * extent + 1e-12)
        assert np.all(ahead >= np.min(points, axis=0) - 2.0 * extent - 1e-12)


def test_what_nothing_explains_stays_where_it_was_seen() -> None:
    walk = np.cumsum(np.random.default_rng(4).normal(0.0, 1e-3, (200, 3)), axis=0)
    path: Path = lambda t: np.asarray(PLACE + walk[round(t / 0.25)])  # noqa: E731
    motion = seen(path, 25.0)
    np.testing.assert_array_equal(motion.at(30.0), motion.last)


def test_too_little_seen_is_no_motion() -> None:
    motion = seen(sine(0.2), SHORTEST - 0.25)
    np.testing.assert_array_equal(motion.at(30.0), motion.last)


def test_time_that_goes_back_begins_anew() -> None:
    motion = seen(sine(0.2), 25.0)
    motion.see(3.0, PLACE)
    np.testing.assert_array_equal(motion.at(30.0), PLACE)


def test_many_targets_are_each_as_alone() -> None:
    paths: list[Path] = [sine(0.2), chest(0.3), lambda _: PLACE, lambda t: PLACE + DRIFT * t]
    both = seen(lambda t: np.stack([path(t) for path in paths]), 25.0)
    times = np.array([26.0, 27.0, 28.0, 29.0])
    alone = [seen(path, 25.0).at(time) for path, time in zip(paths, times, strict=True)]
    np.testing.assert_allclose(both.at(times), alone, atol=1e-9)


def test_a_fast_topic_takes_no_more_memory_than_a_slow_one() -> None:
    fast, slow = seen(sine(0.2), 25.0, every=0.005), seen(sine(0.2), 25.0)
    assert len(fast._times) <= len(slow._times) + 2
    np.testing.assert_allclose(fast.at(30.0), sine(0.2)(30.0), atol=1e-4)
