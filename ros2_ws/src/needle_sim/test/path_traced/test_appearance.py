"""Appearances: drawn by the seed or fixed by name, and their light on the sensor."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from needle_sim.path_traced.appearance import (
    APPEARANCES,
    FLOORS,
    LAMPS,
    METALS,
    RANDOM,
    draw_appearance,
)
from needle_sim.path_traced.renderer import flicker, grey_image


def test_a_name_fixes_its_properties_and_the_seed_draws_the_others_in_full_range() -> None:
    looks = [draw_appearance(RANDOM, seed) for seed in range(60)]
    assert {look.metal for look in looks} == set(METALS)
    assert {look.lamps for look in looks} == set(LAMPS)
    assert {look.floor for look in looks} == set(FLOORS)
    assert all(look.needle for look in looks)
    assert draw_appearance(RANDOM, 7) == looks[7]
    for name, fixed in APPEARANCES.items():
        looks = [draw_appearance(name, seed) for seed in range(5)]
        for look in looks:
            assert (look.name, look.needle) == (name, fixed.needle)
            for kind in ("metal", "lamps", "floor"):
                assert getattr(fixed, kind) in (None, getattr(look, kind))
        assert len({look.floor_level for look in looks}) == 5


def test_the_sensor_blooms_saturates_and_is_noisy() -> None:
    look = dataclasses.replace(
        draw_appearance(RANDOM, 0), noise=2.0, shot_noise=3.0, bloom=0.05, haze=0.0, blur_px=0.5
    )
    light = np.full((60, 200), 100.0, dtype=np.float32)
    light[:, 90:110] = 2000.0
    image = grey_image(light, look, 5.0, np.random.default_rng(0))
    assert image[:, 95:105].min() == 255
    dark = image[:, :60].astype(float)
    assert dark.mean() == pytest.approx(105.0, abs=0.3)
    assert dark.std() == pytest.approx(np.hypot(2.0, 3.0 * np.sqrt(105.0 / 255.0)), rel=0.05)
    assert image[:, 86].mean() > dark.mean() + 20.0
    np.testing.assert_array_equal(image, grey_image(light, look, 5.0, np.random.default_rng(0)))
    steady = dataclasses.replace(look, flicker=0.0)
    assert {flicker(steady, number) for number in range(4)} == {1.0}
