"""Needle maps of images that are drawn here: what is needle, whatever it looks like."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from needle_tracker.image.needle_map import TILE, NeedleMap, tile_counts

Image = NDArray[np.uint8]
SHAPE = (240, 320)
BEGIN, END = (0, 110), (200, 130)
FLOOR = 140.0


def drawn(shaft: float, core: float, width: int = 5, seed: int = 1) -> Image:
    """Draw a needle with a core that a lamp lights, on a noisy floor."""
    image = np.full(SHAPE, FLOOR, np.float32)
    cv2.line(image, BEGIN, END, shaft, width, cv2.LINE_AA)
    cv2.line(image, BEGIN, END, core, max(width // 3, 1), cv2.LINE_AA)
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    noise = np.random.default_rng(seed).normal(0.0, 3.0, SHAPE)
    return np.asarray(np.clip(image + noise, 0.0, 255.0), np.uint8)


def on_shaft(needle_map: Image) -> float:
    """Return the least of the map in the middle of the shaft, over places along it."""
    places = np.linspace(BEGIN, END, 21)[2:-2]
    patches = [
        needle_map[round(v) - 1 : round(v) + 2, round(u) - 1 : round(u) + 2] for u, v in places
    ]
    return float(np.median([patch.max() for patch in patches]))


@pytest.mark.parametrize(
    ("shaft", "core"), [(40.0, 40.0), (60.0, 230.0), (230.0, 230.0)], ids=["dark", "lit", "bright"]
)
def test_shows_the_shaft_and_not_the_floor(shaft: float, core: float) -> None:
    image = drawn(shaft, core)
    found = NeedleMap(5.0).draw(image, (0, 0, SHAPE[1], SHAPE[0]))
    assert on_shaft(found) > 200.0
    assert np.median(found) < 10.0
    assert (found[150:] > 128).mean() < 0.002
    # Past the end there is floor again.
    assert found[125:140, END[0] + 12 : END[0] + 40].max() < 100


def test_finds_a_wide_needle_at_its_own_scale() -> None:
    image = drawn(60.0, 230.0, width=13)
    found = NeedleMap(13.0).draw(image, (0, 0, SHAPE[1], SHAPE[0]))
    assert on_shaft(found) > 150.0
    assert np.median(found) < 10.0


def test_is_drawn_where_it_is_asked_for_and_as_if_all_were() -> None:
    image = drawn(60.0, 230.0)
    whole = NeedleMap(4.6).draw(image, (0, 0, SHAPE[1], SHAPE[0])).astype(int)
    one = NeedleMap(4.6)
    part = one.draw(image, (150, 100, 230, 150)).astype(int)
    assert not part[:, :144].any()
    assert one.drawn == (slice(96, 160), slice(144, 240))
    assert np.abs(part - whole)[100:150, 150:230].max() < 25
    more = one.draw(image, (20, 100, 230, 150)).astype(int)
    assert np.abs(more - whole)[100:150, 20:230].max() < 25
    # Of another image nothing is kept.
    assert not one.draw(np.full(SHAPE, 140, np.uint8), (0, 0, 30, 30))[64:].any()


def test_leaves_out_what_does_not_matter_and_shows_the_rest_as_if_all_were_drawn() -> None:
    image = drawn(60.0, 230.0)
    box = (0, 0, SHAPE[1], SHAPE[0])
    whole = NeedleMap(5.0).draw(image, box).astype(int)
    tiles = np.zeros(tile_counts(image), np.bool_)
    for u, v in np.linspace(BEGIN, END, 40):
        tiles[int(v) // TILE - 1 : int(v) // TILE + 2, int(u) // TILE] = True
    one = NeedleMap(5.0)
    part = one.draw(image, box, tiles).astype(int)
    wanted = np.kron(tiles, np.ones((TILE, TILE), np.bool_))[: SHAPE[0], : SHAPE[1]]
    assert np.abs(part - whole)[wanted].max() < 40
    assert not part[180:].any()
    # What was left out is drawn when it is asked for.
    assert np.abs(one.draw(image, box).astype(int) - whole).max() < 40
