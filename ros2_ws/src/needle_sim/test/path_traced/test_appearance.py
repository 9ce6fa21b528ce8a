"""Looks: drawn by the seed within what is stated, fixed by name, light that a sensor can take."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from needle_core.errors import UserError
from needle_sim.path_traced.appearance import (
    APPEARANCES,
    FLOORS,
    LAMPS,
    METALS,
    RANDOM,
    Floor,
    draw_appearance,
)
from needle_sim.path_traced.floors import floor_picture
from needle_sim.path_traced.sensor import flicker, grey_image

BOUNDS = {
    "roughness_along": (0.05, 0.45),
    "roughness_across": (0.05, 0.45),
    "face_roughness": (0.05, 0.4),
    "diameter": (0.0005, 0.0013),
    "bevel_angle": (np.deg2rad(18.0), np.deg2rad(45.0)),
    "lean": (0.0, np.deg2rad(6.0)),
    "room_light": (0.02, 0.6),
    "floor_height": (-0.035, -0.018),
    "behind": (0.005, 0.12),
    "floor_level": (22.0, 215.0),
    "floor_blur_px": (0.0, 2.5),
    "bubbles": (0, 90),
    "lint": (0, 25),
    "tracks": (0, 4),
    "track_strength": (0.03, 0.35),
    "haze": (0.0, 0.35),
    "blur_px": (0.3, 1.1),
    "bloom": (0.0, 0.05),
    "noise": (0.4, 4.0),
    "shot_noise": (0.5, 5.0),
    "flicker": (0.0, 0.03),
    "lag": (0.0, 0.0002),
}


def test_what_is_drawn_is_within_what_is_stated_and_all_of_it_comes() -> None:
    looks = [draw_appearance(RANDOM, seed) for seed in range(300)]
    for name, (lower, upper) in BOUNDS.items():
        values = [getattr(look, name) for look in looks]
        assert lower <= min(values) < max(values) <= upper, name
    assert {look.metal for look in looks} == set(METALS)
    assert {look.lamps for look in looks} == set(LAMPS)
    assert {look.floor for look in looks} == set(FLOORS)
    assert all(look.needle for look in looks)
    assert draw_appearance(RANDOM, 7) == looks[7]


@pytest.mark.parametrize("name", APPEARANCES)
def test_a_name_fixes_what_it_says_and_the_seed_draws_the_rest(name: str) -> None:
    fixed = APPEARANCES[name]
    looks = [draw_appearance(name, seed) for seed in range(5)]
    for look in looks:
        assert look.name == name
        assert look.needle == fixed.needle
        for kind in ("metal", "lamps", "floor"):
            assert getattr(fixed, kind) in (None, getattr(look, kind))
    assert len({look.floor_level for look in looks}) == 5


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(UserError, match="appearance 'fog' is not one of random, drawn_on_grey"):
        draw_appearance("fog", 0)


@pytest.mark.parametrize("floor", FLOORS)
def test_a_floor_gives_back_a_share_of_the_light(floor: Floor) -> None:
    picture = floor_picture(floor, np.random.default_rng(3))
    assert 0.01 <= picture.reflectance.min() < picture.reflectance.max() <= 0.95
    assert picture.at(np.array([[0.01, -0.02]]), np.array([[0.05, 0.1]])).shape == (1, 2)


def test_the_same_seed_gives_the_same_floor() -> None:
    first, second = (floor_picture("print", np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(first.reflectance, second.reflectance)


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
    again = grey_image(light, look, 5.0, np.random.default_rng(0))
    np.testing.assert_array_equal(image, again)
    steady = dataclasses.replace(look, flicker=0.0)
    assert {flicker(steady, number) for number in range(4)} == {1.0}
