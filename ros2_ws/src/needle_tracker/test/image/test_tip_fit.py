"""Sub-pixel line and end on lines that the test draws itself."""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from needle_tracker.image.detection import DetectionSettings, Path
from needle_tracker.image.tip_fit import ImageTip, fit_tip

SETTINGS = DetectionSettings()


def coarse_path(
    start: np.ndarray, end: np.ndarray, offset: np.ndarray, bright: bool = False
) -> Path:
    steps = np.arange(0.0, float(np.linalg.norm(end - start)), 3.3)
    direction = (end - start) / np.linalg.norm(end - start)
    pixels = start + steps[:, None] * direction + offset
    cells = np.arange(len(steps))
    return Path(cells, cells, pixels, 50.0, bright)


def fitted(
    image: np.ndarray, seed: int, start: np.ndarray, end: np.ndarray, sigma_along: float = 0.0
) -> tuple[ImageTip, float, float]:
    """Return the tip fitted to a noisy image, and how far it is from the end, along and across."""
    noisy = image + np.random.default_rng(seed).normal(0.0, 3.0, image.shape)
    pixels = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
    tip = fit_tip(pixels, coarse_path(start, end, np.zeros(2)), SETTINGS, sigma_along)
    assert tip is not None
    direction = (end - start) / np.linalg.norm(end - start)
    error = tip.point - end
    return tip, float(error @ direction), float(error @ [-direction[1], direction[0]])


@pytest.mark.parametrize("bright", [False, True])
@pytest.mark.parametrize("angle_deg", [17.0, -63.0, 206.0])
def test_end_and_direction_to_a_fraction_of_a_pixel(
    make_line: Callable[..., np.ndarray], angle_deg: float, bright: bool
) -> None:
    rng = np.random.default_rng(int(angle_deg) + 100)
    along, across = [], []
    for _ in range(12):
        direction = np.array([math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))])
        end = np.array([150.0, 150.0]) + rng.uniform(-0.5, 0.5, 2)
        start = end - 100.0 * direction
        image = make_line((300, 300), np.stack([start, end]), 4.6, 60.0 + 120 * bright, 120.0)
        image += np.linspace(0.0, 40.0, 300)[None, :] + rng.normal(0.0, 4.0, image.shape)
        noisy = np.clip(np.round(image), 0, 255).astype(np.uint8)
        about = end + rng.uniform(-6, 6) * direction
        path = coarse_path(start, about, rng.uniform(-1.5, 1.5, 2), bright)
        tip = fit_tip(noisy, path, SETTINGS)
        assert tip is not None
        error = tip.point - end
        along.append(error @ direction)
        across.append(error @ [-direction[1], direction[0]])
        assert tip.direction @ direction > math.cos(math.radians(2.0))
        assert abs(error @ direction) < 4.0 * tip.sigma_along
    assert np.sqrt(np.mean(np.square(along))) < 0.25
    assert np.sqrt(np.mean(np.square(across))) < 0.15


def test_a_bent_shaft_does_not_pull_the_end_aside(make_line: Callable[..., np.ndarray]) -> None:
    radius = 350.0  # [px]: 53 mm, more than the pre-bend's
    turn = np.linspace(-0.3, 0.0, 60)
    points = np.stack([150.0 + radius * np.sin(turn), 150.0 + radius * (1 - np.cos(turn))], axis=-1)
    image = np.round(make_line((300, 300), points, 4.6, 60.0, 150.0)).astype(np.uint8)
    cells = np.arange(len(points))
    tip = fit_tip(image, Path(cells, cells, points, 50.0), SETTINGS)
    assert tip is not None
    np.testing.assert_allclose(tip.point, [150.0, 150.0], atol=0.1)
    np.testing.assert_allclose(tip.direction, [1.0, 0.0], atol=0.01)


@pytest.mark.parametrize("beside", [-3.5, 2.5])
@pytest.mark.parametrize("glint", [False, True])
def test_a_shadow_along_the_needle_does_not_draw_it_aside(
    make_line: Callable[..., np.ndarray], beside: float, glint: bool
) -> None:
    """The shadow is half as dark, blurred and ends farther on; a glint shines on the shaft."""
    start, end = np.array([40.0, 152.3]), np.array([150.0, 150.0])
    line, shape = np.stack([start, end]), (300, 300)
    shift = np.array([0.0, beside])
    shadow = make_line(
        shape, np.stack([start, end + np.array([14.0, -0.3])]) + shift, 5.0, 1.0, 0.0
    )
    light = 160.0 * (1.0 - 0.5 * cv2.GaussianBlur(shadow, (0, 0), 2.0))
    needle = make_line(shape, line, 4.6, 1.0, 0.0)
    image = light + (35.0 - light) * cv2.GaussianBlur(needle, (0, 0), 0.7)
    if glint:
        image += 120.0 * make_line(shape, line[0] + [[0.55], [0.8]] * (end - start), 1.6, 1.0, 0.0)
    tip, _, across = fitted(image, 2, start, end)
    assert abs(across) < 0.35
    assert abs(across) < 3.0 * tip.sigma_across


@pytest.mark.parametrize("beside", [-6.5, 8.0])
@pytest.mark.parametrize("short", [0.0, 9.0])
def test_a_shadow_that_ends_first_does_not_hide_the_needles_end(
    make_line: Callable[..., np.ndarray], beside: float, short: float
) -> None:
    """Beside the shaft is a shadow, beside its end is none: the needle is as dark as before."""
    start, end = np.array([40.0, 152.3]), np.array([150.0, 150.0])
    shape, shift = (300, 300), np.array([0.0, beside])
    line = np.stack([start, end]) + shift - [[0.0, 0.0], [short, 0.0]]
    shadow = cv2.GaussianBlur(make_line(shape, line, 5.0, 1.0, 0.0), (0, 0), 1.2)
    light = 165.0 * (1.0 - 0.42 * shadow)
    needle = make_line(shape, np.stack([start, end]), 4.6, 1.0, 0.0)
    image = light + (40.0 - light) * cv2.GaussianBlur(needle, (0, 0), 0.7)
    tip, along, _ = fitted(image, 3, start, end, 10.0)
    assert tip.clear
    assert abs(along) < min(0.4, 4.0 * tip.sigma_along)
    assert tip.sigma_along < 0.8
    assert tip.contrast == pytest.approx(125.0, rel=0.1)


@pytest.mark.parametrize("apart", [-4.6, 3.0, 4.6])
def test_of_two_lines_that_touch_either_may_be_the_needle(
    make_line: Callable[..., np.ndarray], apart: float
) -> None:
    """A shadow as dark as the needle lies along it: the claim covers the needle's own middle."""
    start, end = np.array([50.0, 150.0]), np.array([150.3, 150.0])
    needle, shadow = (
        make_line((300, 300), np.add([start, end], [0.0, aside]), 4.6, 0.0, 1.0)
        for aside in (0.0, apart)
    )
    tip, _, across = fitted(60.0 + 100.0 * np.minimum(needle, shadow), 5, start, end)
    assert abs(across) < 2.0 * tip.sigma_across
    assert tip.sigma_across > 0.3 * abs(apart)
    alone, _, across = fitted(60.0 + 100.0 * needle, 5, start, end)
    assert abs(across) < 0.15
    assert alone.sigma_across < 0.15


@pytest.mark.parametrize("aside", [-0.4, 0.4])
@pytest.mark.parametrize(("first", "last"), [(0.0, 0.88), (0.6, 1.0)])
def test_a_streak_of_light_along_the_needle_hides_neither_its_line_nor_its_end(
    make_line: Callable[..., np.ndarray], first: float, last: float, aside: float
) -> None:
    """It is as bright as the light beside the needle; the needle's edges stay dark."""
    start, end = np.array([40.0, 152.3]), np.array([150.0, 150.0])
    line, shape = np.stack([start, end]), (300, 300)
    needle = cv2.GaussianBlur(make_line(shape, line, 4.6, 1.0, 0.0), (0, 0), 0.6)
    streak = start + [[first], [last]] * (end - start) + [0.0, aside]
    shine = cv2.GaussianBlur(make_line(shape, streak, 1.6, 1.0, 0.0), (0, 0), 0.6)
    image = 165.0 - 125.0 * needle + 125.0 * shine
    tip, along, across = fitted(image, 5, start, end, 10.0)
    assert tip.clear
    assert abs(along) < min(0.8, 4.0 * tip.sigma_along)
    assert abs(across) < min(0.3, 4.0 * tip.sigma_across)
    assert tip.contrast > 0.66 * 125.0


@pytest.mark.parametrize("bright", [False, True])
def test_how_plainly_it_shows_does_not_depend_on_the_light(
    make_line: Callable[..., np.ndarray], bright: bool
) -> None:
    start, end = np.array([40.0, 150.0]), np.array([150.0, 150.0])
    levels = (120.0, 45.0) if bright else (45.0, 120.0)
    drawn = make_line((300, 300), np.stack([start, end]), 4.6, *levels)
    seen = []
    for light in (0.7, 1.0, 2.0):
        image = np.clip(np.round(light * drawn), 0, 255).astype(np.uint8)
        tip = fit_tip(image, coarse_path(start, end, np.zeros(2), bright), SETTINGS)
        assert tip is not None
        assert tip.contrast == pytest.approx(75.0 * light, rel=0.1)
        seen.append(tip.visibility)
    assert seen == pytest.approx([75.0 / 120.0] * 3, rel=0.06)


def test_nothing_there_is_no_tip() -> None:
    image = np.full((300, 300), 150, np.uint8)
    path = coarse_path(np.array([50.0, 150.0]), np.array([150.0, 150.0]), np.zeros(2))
    assert fit_tip(image, path, SETTINGS) is None


def test_a_line_without_an_end_is_no_tip(make_line: Callable[..., np.ndarray]) -> None:
    ends = np.array([[10.0, 150.0], [290.0, 150.0]])
    image = np.round(make_line((300, 300), ends, 4.6, 60.0, 150.0)).astype(np.uint8)
    path = coarse_path(np.array([50.0, 150.0]), np.array([150.0, 150.0]), np.zeros(2))
    assert fit_tip(image, path, SETTINGS) is None


def draw_needle(end: np.ndarray, bevel: float, blur: float, noise: np.ndarray) -> np.ndarray:
    """Return a needle along u that is 4.6 px wide; one of its edges ends `bevel` px before it."""
    fine = 8
    corners = np.array([[0.0, -2.3], [-bevel, 2.3], [-100.0, 2.3], [-100.0, -2.3]]) + end
    mask = np.zeros((300 * fine, 300 * fine), np.uint8)
    cv2.fillPoly(mask, [np.round((corners + 0.5) * fine - 0.5).astype(np.int32)], 255)
    share = cv2.resize(mask, (300, 300), interpolation=cv2.INTER_AREA) / 255.0
    image = cv2.GaussianBlur(180.0 - 120.0 * share, (0, 0), blur) + noise
    return np.asarray(np.clip(np.round(image), 0, 255), dtype=np.uint8)


@pytest.mark.parametrize("bevel", [0.0, 10.0])
@pytest.mark.parametrize("blur", [0.7, 2.2])
def test_how_well_an_end_is_known_fits_bevels_and_blur(bevel: float, blur: float) -> None:
    rng = np.random.default_rng(3)
    squares, sigmas = [], []
    for _ in range(12):
        end = np.array([180.0, 150.0]) + rng.uniform(-0.5, 0.5, 2)
        image = draw_needle(end, bevel, blur, rng.normal(0.0, 3.0, (300, 300)))
        about = end + np.array([rng.uniform(-4, 4), 0.0])
        path = coarse_path(end - np.array([100.0, 0.0]), about, rng.uniform(-1.0, 1.0, 2))
        tip = fit_tip(image, path, SETTINGS, 8.0)
        assert tip is not None
        assert tip.clear
        error = tip.point - end
        squares.append([(error[1] / tip.sigma_across) ** 2, (error[0] / tip.sigma_along) ** 2])
        sigmas.append([tip.sigma_across, tip.sigma_along])
    assert np.all(np.mean(squares, axis=0) < 6.0)
    across, along = np.median(sigmas, axis=0)
    if blur > 2.0:
        assert across > 0.1
        assert along > 0.8
    elif bevel == 0.0 and blur < 1.0:
        assert across < 0.06
        assert along < 0.2
