"""Torsion: dead band and lag, compared with their definitions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from needle_sim.needle.tissue import Torsion


def test_the_tip_stays_inside_the_dead_band_and_follows_at_its_distance_both_ways() -> None:
    torsion = Torsion(play=0.2)
    base = tip = 0.0
    for turned in (0.2, -0.4, 0.1, 0.25, 1.0, -0.4, -0.1, -2.0):
        torsion.advance(0.001, turned)
        base += turned
        tip = min(max(tip, base - 0.2), base + 0.2)
        assert float(torsion.tip_angle) == pytest.approx(tip, abs=1e-15)


def test_the_lag_follows_its_differential_equation_both_ways() -> None:
    torsion = Torsion(lag_length=0.008)
    # No insertion, no turn of the tip.
    assert float(torsion.advance(0.0, 1.0)) == 0.0
    rng = np.random.default_rng(1)
    base, tip = 1.0, 0.0
    for _ in range(10):
        length, turned = rng.uniform(0.0005, 0.01), rng.uniform(-1.0, 1.0)
        # The friction is the same in retraction.
        torsion.advance(rng.choice((-1.0, 1.0)) * length, turned)
        tip = solve_ivp(
            lambda s, y, base=base, rate=turned / length: (base + rate * s - y) / 0.008,
            (0.0, length),
            [tip],
            rtol=1e-10,
            atol=1e-12,
        ).y[0, -1]
        base += turned
        assert float(torsion.tip_angle) == pytest.approx(tip, abs=1e-8)
