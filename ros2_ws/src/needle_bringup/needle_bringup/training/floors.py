"""Random floors behind a needle, and clutter next to or in front of it.

The ranges are wide, so that the net generalizes. This code is independent of the renderer in
needle_sim, with which the tracker is tested.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]


def floor(rng: np.random.Generator, size: int) -> Image:
    """Return a random floor: plain, cloudy, printed, woven or brushed.

    Parameters
    ----------
    rng : Generator
        Random generator.
    size : int
        Width and height [px].

    Returns
    -------
    ndarray of float32, shape (size, size)
        Brightness, 0 to 255.
    """
    level = rng.uniform(8.0, 60.0) if rng.random() < 0.25 else rng.uniform(50.0, 230.0)
    image = np.full((size, size), level, np.float32)
    y, x = _grid(size)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    image *= 1.0 + rng.uniform(0.0, 0.3) * (np.cos(angle) * x + np.sin(angle) * y) / size
    image *= 1.0 + _cloud(rng, size, rng.uniform(8.0, 30.0)) * rng.uniform(0.0, 0.15)
    if rng.random() < 0.75:
        for i in rng.permutation(len(_PRINTS))[: rng.integers(1, 3)]:
            image = _PRINTS[i](rng, image)
    return np.asarray(np.clip(image, 2.0, 255.0), np.float32)


def clutter(rng: np.random.Generator, image: Image) -> Image:
    """Return an image with bubbles, lint, scratches and old needle tracks in front of it.

    Parameters
    ----------
    rng : Generator
        Random generator.
    image : ndarray of float32, shape (size, size)
        Brightness, 0 to 255.
    """
    for thing, chance, most in ((_bubble, 0.4, 6), (_line, 0.5, 4), (_spot, 0.3, 5)):
        if rng.random() < chance:
            for _ in range(rng.integers(1, most + 1)):
                image = thing(rng, image)
    return np.asarray(image, np.float32)


def _grid(size: int) -> tuple[Image, Image]:
    y, x = np.mgrid[:size, :size].astype(np.float32)
    return y - size / 2, x - size / 2


def _cloud(rng: np.random.Generator, size: int, sigma: float) -> Image:
    coarse = max(int(size / sigma) + 3, 4)
    field = rng.standard_normal((coarse, coarse)).astype(np.float32)
    return np.asarray(cv2.resize(field, (size, size), interpolation=cv2.INTER_CUBIC), np.float32)


def _lines(rng: np.random.Generator, image: Image) -> Image:
    """Draw graph paper: one or two sets of parallel lines, some thicker."""
    size = len(image)
    y, x = _grid(size)
    ink = rng.uniform(0.1, 0.9)
    pitch = rng.uniform(8.0, 45.0)
    first = rng.uniform(0.0, np.pi) if rng.random() < 0.5 else rng.normal(0.0, 0.1)
    for angle in (first, first + np.pi / 2)[: rng.integers(1, 3)]:
        across = np.cos(angle) * x + np.sin(angle) * y + rng.uniform(0.0, pitch)
        number = np.round(across / pitch)
        thick = rng.uniform(0.4, 1.6) * (1.0 + (number % rng.integers(2, 6) == 0))
        cover = np.clip(thick - np.abs(across - number * pitch) + 0.5, 0.0, 1.0)
        image = image * (1.0 - ink * cover)
    return np.asarray(image, np.float32)


def _grain(rng: np.random.Generator, image: Image) -> Image:
    """Draw grain in one direction or none: brushed metal, paper, rough plastic."""
    noise = rng.standard_normal(image.shape).astype(np.float32)
    if rng.random() < 0.5:
        noise = _streaked(rng, noise)
    else:
        noise = cv2.GaussianBlur(noise, (0, 0), rng.uniform(0.5, 3.0))
    return np.asarray(
        image * (1.0 + rng.uniform(0.02, 0.18) * noise / max(float(noise.std()), 1e-6)), np.float32
    )


def _streaked(rng: np.random.Generator, noise: Image) -> Image:
    length = int(rng.integers(7, 41)) | 1
    kernel = np.zeros((length, length), np.float32)
    angle, middle = rng.uniform(0.0, np.pi), length // 2
    ends = [round(middle * (1 + s * f)) for s in (-1, 1) for f in (np.cos(angle), np.sin(angle))]
    cv2.line(kernel, (ends[0], ends[1]), (ends[2], ends[3]), 1.0)
    return np.asarray(cv2.filter2D(noise, -1, kernel / kernel.sum()), np.float32)


def _weave(rng: np.random.Generator, image: Image) -> Image:
    y, x = _grid(len(image))
    pitch, angle = rng.uniform(2.5, 9.0), rng.uniform(0.0, np.pi)
    u = np.cos(angle) * x + np.sin(angle) * y
    v = -np.sin(angle) * x + np.cos(angle) * y
    wave = np.sin(2 * np.pi * u / pitch) * np.sin(2 * np.pi * v / pitch)
    return np.asarray(image * (1.0 + rng.uniform(0.03, 0.2) * wave), np.float32)


def _blocks(rng: np.random.Generator, image: Image) -> Image:
    """Draw edges of walls and plates."""
    result = image.copy()
    size = len(image)
    for _ in range(rng.integers(1, 5)):
        centre = rng.uniform(0.0, size, 2)
        extent = rng.uniform(4.0, size, 2)
        box = cv2.boxPoints((tuple(centre), tuple(extent), float(rng.uniform(0.0, 180.0))))
        mask = np.zeros_like(image)
        cv2.fillPoly(mask, [np.round(box * 16).astype(np.int32)], 1.0, cv2.LINE_AA, 4)
        result = result * (1.0 - mask) + result * mask * rng.uniform(0.3, 1.7)
    return np.asarray(result, np.float32)


def _print(rng: np.random.Generator, image: Image) -> Image:
    result = image.copy()
    for _ in range(rng.integers(1, 4)):
        text = "".join(rng.choice(list("0123456789mABDEKRWlI-|/+"), rng.integers(1, 6)))
        place = tuple(int(c) for c in rng.uniform(-10, len(image), 2))
        mask = np.zeros(image.shape, np.uint8)
        cv2.putText(
            mask,
            text,
            place,
            int(rng.integers(0, 4)),
            float(rng.uniform(0.3, 1.3)),
            255,
            int(rng.integers(1, 4)),
            cv2.LINE_AA,
        )
        share = mask.astype(np.float32) / 255.0
        result = result * (1.0 - share * rng.uniform(0.2, 0.9))
    return np.asarray(result, np.float32)


_PRINTS = (_lines, _grain, _weave, _blocks, _print)


def _bubble(rng: np.random.Generator, image: Image) -> Image:
    size = len(image)
    y, x = _grid(size)
    centre, radius = rng.uniform(-size / 2, size / 2, 2), rng.uniform(1.0, 6.0)
    away = np.hypot(x - centre[0], y - centre[1])
    ring = np.exp(-(((away - radius) / rng.uniform(0.5, 1.5)) ** 2))
    image = image * (1.0 - rng.uniform(0.1, 0.8) * ring)
    glint = np.exp(-((x - centre[0] + radius / 2) ** 2 + (y - centre[1] + radius / 2) ** 2) / 1.5)
    return np.asarray(image + rng.uniform(0.0, 200.0) * glint, np.float32)


def _line(rng: np.random.Generator, image: Image) -> Image:
    """Draw a scratch, lint or an old track, which is thinner or fainter than a needle."""
    size = len(image)
    start, heading = rng.uniform(-size / 8, 1.125 * size, 2), rng.uniform(0.0, 2 * np.pi)
    bend = rng.normal(0.0, 0.02)
    steps = np.arange(0.0, rng.uniform(6.0, 1.5 * size), 2.0)
    angles = heading + bend * steps
    points = start + 2.0 * np.cumsum(np.stack([np.cos(angles), np.sin(angles)], 1), axis=0)
    mask = np.zeros_like(image)
    thin = rng.random() < 0.6
    width = 1 if thin else int(rng.integers(2, 8))
    cv2.polylines(mask, [np.round(points * 16).astype(np.int32)], False, 1.0, width, cv2.LINE_AA, 4)
    if not thin:
        mask = cv2.GaussianBlur(mask, (0, 0), rng.uniform(0.8, 3.0))
    share = rng.uniform(-0.6, 0.6) if thin else rng.uniform(-0.2, 0.2)
    return np.asarray(np.clip(image * (1.0 + share * mask), 0.0, 400.0), np.float32)


def _spot(rng: np.random.Generator, image: Image) -> Image:
    y, x = _grid(len(image))
    centre = rng.uniform(-len(image) / 2, len(image) / 2, 2)
    sigma = rng.uniform(0.6, 4.0)
    blob = np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * sigma**2))
    return np.asarray(
        np.clip(image * (1.0 + rng.uniform(-0.9, 1.5) * blob), 0.0, 400.0), np.float32
    )
