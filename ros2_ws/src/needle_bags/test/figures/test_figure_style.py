"""Colours that can be told apart and seen, by everybody, in both modes."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from needle_bags.figures import figure_style as style

LINES = {
    name: getattr(style, name)
    for name in ("INK", "TRUTH", "MEASURED", "ESTIMATE", "GOAL_BAND", "PLUM", "TEAL", "RED")
}
# Machado, Oliveira, Fernandes 2009, severity 1: linear RGB as who lacks one kind of cones sees it.
VISION = {
    "full": np.eye(3),
    "no red": [[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.0520]],
    "no green": [[0.3673, 0.8606, -0.2280], [0.2801, 0.6725, 0.0474], [-0.0118, 0.0429, 0.9689]],
    "no blue": [[1.2555, -0.0767, -0.1788], [-0.0784, 0.9308, 0.1476], [0.0047, 0.6914, 0.3039]],
}
TO_XYZ = np.array(
    [[0.41246, 0.35758, 0.18044], [0.21267, 0.71515, 0.07218], [0.01933, 0.11919, 0.95030]]
)


def srgb(text: str) -> np.ndarray:
    return np.array([int(text[at : at + 2], 16) / 255.0 for at in (1, 3, 5)])


def linear(color: np.ndarray) -> np.ndarray:
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


def in_the_dark(color: np.ndarray) -> np.ndarray:
    """CSS: invert(.92) hue-rotate(180deg)."""
    inverted = color * 0.08 + (1.0 - color) * 0.92
    grey = np.array([[0.213, 0.715, 0.072]] * 3)
    return np.clip((2.0 * grey - np.eye(3)) @ inverted, 0.0, 1.0)


def contrast(one: np.ndarray, other: np.ndarray) -> float:
    low, high = sorted(float(linear(color) @ TO_XYZ[1]) for color in (one, other))
    return (high + 0.05) / (low + 0.05)


def lab(rgb: np.ndarray) -> np.ndarray:
    xyz = TO_XYZ @ np.clip(rgb, 0.0, 1.0) / np.array([0.95047, 1.0, 1.08883])
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16.0 / 116.0)
    return np.array([116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])])


def test_lines_contrast_with_the_background() -> None:
    for name, line in LINES.items():
        color, white = srgb(line), np.ones(3)
        assert contrast(color, white) >= 3.0, name
        assert contrast(in_the_dark(color), in_the_dark(white)) >= 3.0, name


@pytest.mark.parametrize("vision", VISION)
def test_line_colours_are_distinguishable(vision: str) -> None:
    matrix = np.array(VISION[vision])
    for one, other in itertools.combinations(LINES, 2):
        for mode in (lambda color: color, in_the_dark):
            seen = [lab(matrix @ linear(mode(srgb(LINES[name])))) for name in (one, other)]
            assert np.linalg.norm(seen[0] - seen[1]) >= 10.0, (one, other)
