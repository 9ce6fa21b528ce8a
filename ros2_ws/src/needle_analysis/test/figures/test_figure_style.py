"""Colours that can be told apart and seen, by everybody, in both modes."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from needle_analysis.figures import figure_style as style

LINES = {
    name: getattr(style, name)
    for name in ("INK", "TRUTH", "MEASURED", "ESTIMATE", "GOAL_BAND", "PLUM", "TEAL", "RED")
}
# Machado, Oliveira, Fernandes 2009, severity 1: linear RGB as who lacks one kind of cones sees it.
VISION = {
    "full": np.eye(3),
    "no red": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "no green": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
    "no blue": np.array(
        [
            [1.255528, -0.076749, -0.178779],
            [-0.078411, 0.930809, 0.147602],
            [0.004733, 0.691367, 0.303900],
        ]
    ),
}
TO_XYZ = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
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


@pytest.mark.parametrize("name", LINES)
def test_every_line_stands_out_from_its_ground(name: str) -> None:
    color, white = srgb(LINES[name]), np.ones(3)
    assert contrast(color, white) >= 3.0
    assert contrast(in_the_dark(color), in_the_dark(white)) >= 3.0


@pytest.mark.parametrize("vision", VISION)
def test_any_two_lines_can_be_told_apart(vision: str) -> None:
    for one, other in itertools.combinations(LINES, 2):
        for mode in (lambda color: color, in_the_dark):
            seen = [lab(VISION[vision] @ linear(mode(srgb(LINES[name])))) for name in (one, other)]
            assert np.linalg.norm(seen[0] - seen[1]) >= 10.0, (one, other)
