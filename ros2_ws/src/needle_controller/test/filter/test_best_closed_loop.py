"""Closed loop of preset `best` with independently simulated needles."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_controller.filter.filter_settings import FilterSettings
from needle_controller.laws.roll_law import RollLawSettings
from needle_controller.many_needles import ManyFilters
from needle_controller.model.arrays import Array

STEP = 0.001


def steered(
    seed: int,
    *,
    curvature: float = 1.0 / 0.122,
    play_deg: float = 0.0,
    late: bool = False,
    outliers: float = 0.0,
    dropped: float = 0.0,
    flips: int = 0,
    noise: float = 0.001,
    settings: FilterSettings | None = None,
    covariance: Array | None = None,
    count: int = 40,
) -> Array:
    """Return true x at every step of the given needles, shape (121, needles) [m]."""
    rng = np.random.default_rng(seed)
    steps, play = 120, np.deg2rad(play_deg)
    tip = np.zeros((count, 3))
    tip[:, 0] = rng.uniform(-0.003, 0.003, count)
    angles = np.deg2rad(rng.uniform(-1.0, 1.0, (count, 2)) * [10.0, 30.0])
    rotation = Rotation.from_euler("YZ", angles)
    base, turned, sign = np.zeros(count), np.zeros(count), 1.0
    filters = ManyFilters(settings or FilterSettings(), count, STEP)
    path, last = [tip[:, 0].copy()], np.empty(0)
    filters.start(tip + rng.uniform(-noise, noise, tip.shape))
    at = set(np.round(np.arange(1, flips + 1) * steps / (flips + 1)).astype(int).tolist())
    for step in range(steps):
        sign = -sign if step in at else sign
        rate = filters.roll_rates(RollLawSettings(), sign if flips else 0.0)
        base = base + rate * STEP
        followed = np.clip(turned, base - play, base + play)
        half = np.zeros((count, 3))
        half[:, 0], half[:, 2] = 0.5 * curvature * STEP, 0.5 * (followed - turned)
        middle = rotation * Rotation.from_rotvec(half)
        tip = tip + STEP * middle.apply([0.0, 0.0, 1.0])
        rotation, turned = middle * Rotation.from_rotvec(half), followed
        path.append(tip[:, 0].copy())
        seen = tip + rng.uniform(-noise, noise, tip.shape)
        direction = rng.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        off = (rng.random(count) < outliers)[:, None]
        seen = np.where(off, seen + direction * rng.uniform(0.005, 0.01, (count, 1)), seen)
        seen[rng.random(count) < dropped] = np.nan
        filters.advance(np.full(count, STEP), rate * STEP)
        if not late:
            filters.correct(seen, covariance, np.zeros(count))
        elif step > 0:
            filters.correct(last, None, np.full(count, STEP))
        last = seen
    return np.array(path)


@pytest.mark.parametrize(
    ("least", "largest_rms", "trouble"),
    [
        (0.97, 0.0005, {}),
        (0.97, 0.0005, {"curvature": 0.8 / 0.122}),
        (0.97, 0.0005, {"curvature": 1.2 / 0.122}),
        (0.92, 0.0007, {"play_deg": 40.0}),
        (0.97, 0.0005, {"late": True}),
        (0.97, 0.0005, {"outliers": 0.05, "dropped": 0.2}),
        (0.97, 0.0005, {"flips": 11}),
    ],
)
def test_converges(least: float, largest_rms: float, trouble: dict[str, float]) -> None:
    end = steered(11, **trouble)[-20:]  # type: ignore[arg-type]
    assert np.mean(np.abs(end[-1]) <= 0.001) >= least
    assert np.sqrt(np.mean(end**2)) <= largest_rms


@pytest.mark.parametrize(
    ("noise", "covariance", "play_deg"),
    [
        (1e-5, None, 10.0),
        (1e-4, None, 0.0),
        (1e-5, np.eye(3) * 1e-12, 0.0),
        (1e-4, np.diag([4e-10, 1e-11, 1e-11]), 10.0),
    ],
)
def test_an_accurate_sensor_does_not_cause_overconfidence(
    noise: float, covariance: Array | None, play_deg: float
) -> None:
    """With tips this accurate, a linear filter would be certain of a wrong roll."""
    settings = FilterSettings(tip_noise_bound=noise)
    end = steered(13, noise=noise, settings=settings, covariance=covariance, play_deg=play_deg)
    assert np.mean(np.abs(end[-20:]) <= 0.001) >= 0.995
    assert np.sqrt(np.mean(end[-20:] ** 2)) <= 0.00025
