"""Torsion: dead band and lag, each against what defines it. Noise: its bounds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from needle_sim.needle.tissue import Torsion, measured_tip


def test_off_by_default() -> None:
    torsion = Torsion()
    for turned in (0.1, -0.4, 2.0):
        assert float(torsion.advance(0.001, turned)) == pytest.approx(turned)


def test_inside_the_dead_band_the_tip_stays() -> None:
    torsion = Torsion(play=0.2)
    for turned in (0.2, -0.4, 0.1, 0.25):
        assert float(torsion.advance(0.001, turned)) == pytest.approx(0.0, abs=1e-15)


def test_outside_the_dead_band_the_tip_follows_at_its_distance_both_ways() -> None:
    torsion = Torsion(play=0.2)
    torsion.advance(0.001, 1.0)
    assert float(torsion.tip_angle) == pytest.approx(0.8)
    torsion.advance(0.001, -0.4)
    assert float(torsion.tip_angle) == pytest.approx(0.8)
    torsion.advance(0.001, -0.1)
    assert float(torsion.tip_angle) == pytest.approx(0.7)
    assert float(torsion._base) == pytest.approx(0.5)


def test_lag_leaves_one_over_e_after_its_length() -> None:
    torsion = Torsion(lag_length=0.008)
    assert float(torsion.advance(0.0, 1.0)) == 0.0  # no insertion, no turn of the tip
    torsion.advance(0.008, 0.0)
    assert float(torsion.tip_angle) == pytest.approx(1.0 - np.exp(-1.0))
    torsion.advance(0.5, 0.0)
    assert float(torsion.tip_angle) == pytest.approx(1.0)


def test_lag_follows_its_differential_equation() -> None:
    torsion = Torsion(lag_length=0.008)
    rng = np.random.default_rng(1)
    base = tip = 0.0
    for _ in range(20):
        length, turned = rng.uniform(0.0005, 0.01), rng.uniform(-1.0, 1.0)
        torsion.advance(length, turned)
        tip = solve_ivp(
            lambda s, y, base=base, rate=turned / length: (base + rate * s - y) / 0.008,
            (0.0, length),
            [tip],
            rtol=1e-10,
            atol=1e-12,
        ).y[0, -1]
        base += turned
        assert float(torsion.tip_angle) == pytest.approx(tip, abs=1e-8)


@pytest.mark.parametrize(("play", "lag"), [(0.0, 0.008), (0.3, 0.0), (0.3, 0.008)])
def test_splitting_a_step_changes_nothing(play: float, lag: float) -> None:
    whole, parts = Torsion(play, lag), Torsion(play, lag)
    for turned in (0.5, 0.2, -0.9, 0.4, 0.0):
        whole.advance(0.004, turned)
        for share in (0.05, 0.4, 0.3, 0.25):
            parts.advance(share * 0.004, share * turned)
        assert float(parts.tip_angle) == pytest.approx(float(whole.tip_angle), abs=1e-13)


def test_drawing_back_rubs_like_pushing() -> None:
    forward, backward = Torsion(0.1, 0.005), Torsion(0.1, 0.005)
    assert float(forward.advance(0.003, 0.7)) == float(backward.advance(-0.003, 0.7))


@pytest.mark.parametrize("bad", [{"play": -0.1}, {"lag_length": np.nan}, {"play": [0.0, np.inf]}])
def test_bad_figures_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="must be finite and not negative"):
        Torsion(**bad)  # type: ignore[arg-type]


def test_noise_is_uniform_within_its_bound_and_keyed() -> None:
    tips = np.tile([0.001, 0.002, 0.05], (20_000, 1))
    noisy = measured_tip(tips, 0.001, np.random.default_rng(7))
    error = noisy - tips
    assert np.abs(error).max() <= 0.001 + 1e-15
    np.testing.assert_allclose(error.std(axis=0), 0.001 / np.sqrt(3.0), rtol=0.02)
    np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=2e-5)
    np.testing.assert_array_equal(noisy, measured_tip(tips, 0.001, np.random.default_rng(7)))
    with pytest.raises(ValueError, match="amplitude"):
        measured_tip(tips[0], -0.001, np.random.default_rng(7))
