"""What stands behind the needle: taken away where it has lines, left where it has none."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from needle_tracker.image.background import Background

Image = NDArray[np.uint8]
SHAPE = (240, 320)
ENTRY = np.array([20.0, 120.0])
NEW = 14.0
EVERYWHERE = (slice(None), slice(None))


def floor(seed: int, *, lines: bool, light: float = 1.0, needle: bool = False) -> Image:
    """Draw graph paper or a plain floor, with or without a needle from the entry on."""
    image = np.full(SHAPE, 150.0, np.float32)
    if lines:
        for at in range(10, 320, 20):
            cv2.line(image, (at, 0), (at, 239), 60.0, 2)
            cv2.line(image, (0, at), (319, at), 60.0, 2)
    if needle:
        cv2.line(image, (20, 120), (200, 123), 20.0, 5, cv2.LINE_AA)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, SHAPE)
    return np.asarray(np.clip(light * image + noise, 0.0, 255.0), np.uint8)


@pytest.mark.parametrize("light", [0.8, 1.0, 1.15])
def test_takes_the_lines_away_and_leaves_the_needle(light: float) -> None:
    background = Background(floor(1, lines=True), ENTRY, None)
    rest = background.difference(floor(2, lines=True, light=light, needle=True))
    assert rest is not None
    around = rest[150:].astype(float)
    assert around.mean() == pytest.approx(128.0, abs=3.0)
    assert around.std() < 4.5
    assert np.median(rest[120:123, 40:180]) < 40.0


def test_a_plain_floor_is_better_as_it_is() -> None:
    background = Background(floor(1, lines=False), ENTRY, None)
    assert background.difference(floor(2, lines=False, needle=True)) is None


def test_a_camera_that_was_touched_leaves_the_image_as_it_is() -> None:
    moved = np.roll(floor(1, lines=True), (9, 7), axis=(0, 1))
    background = Background(np.ascontiguousarray(moved), ENTRY, None)
    assert background.difference(floor(2, lines=True, needle=True)) is None


def test_an_empty_phantom_has_no_seam() -> None:
    background = Background(floor(1, lines=True), ENTRY, None)
    assert background.is_empty
    assert background.beyond_seam(ENTRY) == np.inf


def test_the_first_pair_is_its_own_background_and_has_nothing_new() -> None:
    image = floor(1, lines=True, needle=True)
    assert Background(image, ENTRY, NEW).difference(image.copy()) is None
    # Without any needle in it there is none, whatever its lines look like.
    assert Background(image, ENTRY, None).difference(image.copy()) is not None


def line_map(begin: int, end: int) -> Image:
    """Return a map with needle between two columns."""
    drawn = np.zeros(SHAPE, np.uint8)
    drawn[118:123, begin:end] = 240
    return drawn


def test_beyond_what_is_new_there_is_no_needle_though_it_is_not_known_where_it_was() -> None:
    background = Background(floor(1, lines=True), ENTRY, NEW)
    # To the map of the image, a line of the paper goes on from the needle's end.
    whole, before = line_map(25, 300), line_map(25, 180)
    joined = background.joined(whole, line_map(180, 220), before, EVERYWHERE)
    assert (joined[120, 25:220] > 128).all()
    assert not joined[:, 222:].any()
    assert background.beyond_seam(np.array([182.0, 120.0])) == pytest.approx(2.0, abs=1.0)
    assert background.beyond_seam(np.array([150.0, 120.0])) == pytest.approx(-30.0, abs=1.0)
    assert not background.is_empty


def test_too_little_that_is_new_says_nothing() -> None:
    background = Background(floor(1, lines=True), ENTRY, NEW)
    whole = line_map(25, 300)
    joined = background.joined(whole, line_map(180, 190), line_map(25, 180), EVERYWHERE)
    assert (joined == whole).all()
    assert background.beyond_seam(np.array([182.0, 120.0])) == -np.inf


def test_where_a_needle_has_gone_nothing_is_new() -> None:
    background = Background(floor(1, lines=True), ENTRY, NEW)
    whole = line_map(25, 180)
    joined = background.joined(whole, line_map(180, 220), line_map(25, 220), EVERYWHERE)
    assert (joined == whole).all()


@pytest.mark.parametrize("gone", [False, True])
def test_what_was_not_drawn_need_not_be_looked_at(*, gone: bool) -> None:
    before = line_map(25, 220 if gone else 180)
    whole, new = line_map(25, 180 if gone else 230), line_map(180, 220)
    joined, seams = [], []
    for within in (EVERYWHERE, (slice(112, 128), slice(16, 240))):
        background = Background(floor(1, lines=True), ENTRY, NEW)
        joined.append(background.joined(whole, new, before, within))
        seams.append(background.beyond_seam(np.array([200.0, 120.0])))
    assert (joined[0] == joined[1]).all()
    assert joined[0].any()
    assert seams[0] == seams[1]
