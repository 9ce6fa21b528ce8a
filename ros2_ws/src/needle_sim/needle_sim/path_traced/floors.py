"""Floors under the phantom: pictures of their reflectance."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_sim.camera.optics import FloatImage
from needle_sim.path_traced.appearance import ALBEDO, Floor

# Extent of the picture: across the needle over its rows, z over its columns [m].
SIDE = 0.1
BEGIN = -0.06
END = 0.2
SPACING = 0.0001
"""Spacing of the pixels [m]."""

_SHAPE = (round(2.0 * SIDE / SPACING), round((END - BEGIN) / SPACING))
_WORDS = ("needle", "phantom", "gel 35 mm", "sample 04", "do not shake", "lot 2.1", "top", "up")


def floor_picture(floor: Floor, rng: np.random.Generator) -> FloatImage:
    """Return the reflectance of a random floor of a kind, or the brightness of a lit panel.

    Parameters
    ----------
    floor : str
        One of `FLOORS`.
    rng : numpy.random.Generator
        Generator of the texture.
    """
    picture = np.full(_SHAPE, ALBEDO[floor], dtype=np.float32)
    if floor == "panel":
        picture *= 1.0 + rng.uniform(0.0, 0.04) * _noise(rng, rng.uniform(0.02, 0.05))
    else:
        picture *= 1.0 + rng.uniform(0.01, 0.06) * _noise(rng, rng.uniform(0.006, 0.02))
        picture *= 1.0 + rng.uniform(0.005, 0.04) * _noise(rng, rng.uniform(0.0001, 0.0006))
    if texture := _TEXTURES.get(floor):
        picture *= texture(rng)
    return np.asarray(np.clip(picture, 0.01, 0.95))


def _noise(rng: np.random.Generator, size: float, size_z: float | None = None) -> FloatImage:
    """Return Gaussian noise of unit variance with blotches of a size (along y; along z) [m]."""
    sizes = [max(one / SPACING, 0.5) for one in (size, size if size_z is None else size_z)]
    # Wide blotches are computed at low resolution and enlarged, which is faster.
    coarse = [max(int(one / 4.0), 1) for one in sizes]
    shape = [-(-full // small) for full, small in zip(_SHAPE, coarse, strict=True)]
    noise = rng.standard_normal(shape, dtype=np.float32)
    blur = [one / small for one, small in zip(sizes, coarse, strict=True)]
    noise = cv2.GaussianBlur(noise, (0, 0), sigmaX=blur[1], sigmaY=blur[0])
    noise = cv2.resize(noise, _SHAPE[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(noise / noise.std(), dtype=np.float32)


def _turned(rng: np.random.Generator, largest: float) -> tuple[FloatImage, FloatImage]:
    """Return coordinates along two axes, rotated by a random angle up to a maximum [rad], in m."""
    angle, shift = rng.uniform(-largest, largest), rng.uniform(0.0, 0.1, 2)
    y = (np.arange(_SHAPE[0], dtype=np.float32) * np.float32(SPACING))[:, np.newaxis]
    z = np.arange(_SHAPE[1], dtype=np.float32) * np.float32(SPACING)
    cos, sin = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    return cos * z + sin * y + np.float32(shift[0]), cos * y - sin * z + np.float32(shift[1])


def _ruled(at: FloatImage, pitch: float, width: float) -> FloatImage:
    """Return 1 on lines of a width and pitch, 0 in between, with edges of one pixel."""
    away = np.abs((at / np.float32(pitch)) % 1.0 - 0.5) * np.float32(pitch)
    return np.asarray(np.clip((width / 2.0 - away) / SPACING + 0.5, 0.0, 1.0), dtype=np.float32)


def _lines(rng: np.random.Generator) -> FloatImage:
    pitch = float(rng.choice([0.001, 0.002, 0.0025, 0.005]))
    every = int(rng.choice([2, 4, 5, 10]))
    thin, thick = rng.uniform(0.00012, 0.0003), rng.uniform(0.0003, 0.0006)
    faint, strong = rng.uniform(0.15, 0.6), rng.uniform(0.3, 0.75)
    ink = np.zeros(_SHAPE, dtype=np.float32)
    for at in _turned(rng, 0.15 if rng.random() < 0.7 else np.pi):
        ink = np.maximum(ink, faint * _ruled(at, pitch, thin))
        ink = np.maximum(ink, strong * _ruled(at, pitch * every, thick))
    return np.asarray(1.0 - ink, dtype=np.float32)


def _streaks(rng: np.random.Generator) -> FloatImage:
    """Return the scratches of brushed metal, along the needle or across it."""
    long, thin = rng.uniform(0.01, 0.06), rng.uniform(0.0001, 0.0002)
    size = (thin, long) if rng.random() < 0.5 else (long, thin)
    strength, wide = rng.uniform(0.04, 0.15), rng.uniform(0.02, 0.08)
    streaks = 1.0 + strength * _noise(rng, *size) + wide * _noise(rng, 3 * size[0], 3 * size[1])
    return np.asarray(np.clip(streaks, 0.3, 1.7), dtype=np.float32)


def _weave(rng: np.random.Generator) -> FloatImage:
    pitch, depth = rng.uniform(0.0004, 0.0012), rng.uniform(0.06, 0.25)
    first, second = _turned(rng, np.pi)
    turn = np.float32(2.0 * np.pi / pitch)
    cloth = 1.0 + depth * np.sin(turn * first) * np.sin(turn * second)
    cloth = cloth * (1.0 + 0.08 * _noise(rng, 0.0008))
    for _ in range(rng.integers(0, 5)):
        # Folds and seams: dark, wide, in random directions.
        at, width = _turned(rng, np.pi)[0], rng.uniform(0.0008, 0.004)
        away = (at - np.float32(rng.uniform(at.min(), at.max()))) / np.float32(width)
        cloth = cloth * (1.0 - rng.uniform(0.2, 0.6) * np.exp(-0.5 * away * away))
    return np.asarray(np.clip(cloth, 0.1, 1.8), dtype=np.float32)


def _dots(rng: np.random.Generator) -> FloatImage:
    """Return the dot lattice of a light panel."""
    strength, turn = rng.uniform(0.0, 0.03), np.float32(2.0 * np.pi / rng.uniform(0.0015, 0.006))
    first, second = _turned(rng, 0.1)
    dots = (np.cos(turn * first) * np.cos(turn * second)) ** 2
    return np.asarray(1.0 - strength * dots, dtype=np.float32)


def _print(rng: np.random.Generator) -> FloatImage:
    """Return black words, bars and rings of 1.5 to 9 mm."""
    ink: NDArray[np.uint8] = np.zeros(_SHAPE, dtype=np.uint8)
    rows, columns = _SHAPE
    for _ in range(rng.integers(8, 60)):
        place = (int(rng.integers(columns)), int(rng.integers(rows)))
        size = float(rng.uniform(0.0015, 0.009)) / SPACING
        thick = max(round(size * float(rng.uniform(0.05, 0.16))), 1)
        shape = rng.random()
        if shape < 0.75:
            words = " ".join(rng.choice(_WORDS, rng.integers(1, 5)))
            font = cv2.FONT_HERSHEY_SIMPLEX
            cv2.putText(ink, words, place, font, size / 22.0, 255, thick, cv2.LINE_AA)
        elif shape < 0.9:
            turn = float(rng.uniform(0.0, np.pi))
            reach = size * float(rng.uniform(2.0, 12.0))
            other = (place[0] + int(reach * np.cos(turn)), place[1] + int(reach * np.sin(turn)))
            cv2.line(ink, place, other, 255, thick, cv2.LINE_AA)
        else:
            cv2.circle(ink, place, round(size), 255, thick, cv2.LINE_AA)
    strength = rng.uniform(0.3, 0.9)
    return np.asarray(1.0 - strength / 255.0 * ink, dtype=np.float32)


def _clutter(rng: np.random.Generator) -> FloatImage:
    """Return rails, cables and screws of 0.2 to 2 times the wall's brightness."""
    factor = np.ones(_SHAPE, dtype=np.float32)
    rows, columns = _SHAPE

    def place() -> tuple[int, int]:
        return int(rng.integers(columns)), int(rng.integers(rows))

    for _ in range(rng.integers(2, 7)):
        # Rails and edges: along the needle or across it, slightly rotated.
        middle = place()
        size = (rng.uniform(0.04, 0.25) / SPACING, rng.uniform(0.003, 0.03) / SPACING)
        turned = float(rng.normal(0.0, 3.0)) + (90.0 if rng.random() < 0.4 else 0.0)
        corners = cv2.boxPoints((middle, size, turned)).astype(np.int32)
        shade = float(rng.uniform(0.3, 1.6))
        cv2.fillPoly(factor, [corners], shade, cv2.LINE_AA)
        if rng.random() < 0.6:
            cv2.polylines(
                factor, [corners], True, 0.4 * shade, int(rng.integers(2, 12)), cv2.LINE_AA
            )
    for _ in range(rng.integers(0, 4)):
        bend = np.cumsum(rng.normal(0.0, 0.006, (30, 2)).cumsum(axis=0), axis=0) / SPACING / 3.0
        cable = (bend + place()).astype(np.int32)
        thick = round(float(rng.uniform(0.001, 0.006)) / SPACING)
        shade = float(rng.uniform(0.1, 0.6))
        cv2.polylines(factor, [cable], False, shade, thick, cv2.LINE_AA)
        cv2.polylines(factor, [cable], False, 1.8 * shade, max(thick // 4, 1), cv2.LINE_AA)
    for _ in range(rng.integers(2, 12)):
        # Head of a screw, with its slot.
        middle, radius = place(), round(float(rng.uniform(0.0015, 0.006)) / SPACING)
        bright = float(rng.uniform(0.4, 2.0))
        cv2.circle(factor, middle, radius + 4, 0.3, -1, cv2.LINE_AA)
        cv2.circle(factor, middle, radius, bright, -1, cv2.LINE_AA)
        turned = float(rng.uniform(0.0, np.pi))
        away = round(0.8 * radius * np.cos(turned)), round(0.8 * radius * np.sin(turned))
        first, last = ((middle[0] + k * away[0], middle[1] + k * away[1]) for k in (-1, 1))
        cv2.line(factor, first, last, 0.2, max(radius // 4, 1), cv2.LINE_AA)
    return np.asarray(cv2.GaussianBlur(factor, (0, 0), rng.uniform(1.0, 6.0)), dtype=np.float32)


_TEXTURES: dict[Floor, Callable[[np.random.Generator], FloatImage]] = {
    "graph": _lines,
    "brushed": _streaks,
    "cloth": _weave,
    "print": _print,
    "clutter": _clutter,
    "panel": _dots,
}
