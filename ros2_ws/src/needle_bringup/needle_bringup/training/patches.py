"""Patches to learn from: a scene as a camera sees it, and the map that is wanted of it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_bringup.training.floors import clutter, floor
from needle_bringup.training.needle_ends import draw_needle, draw_shadow, random_pose, true_map

Image = NDArray[np.float32]
SIZE = 96
WIDTH = 5.0
"""Of a needle in what the net sees [px]."""
LIKE = (0.75, 1.3)
"""Widths that it sees, as a ratio to that."""


def patch(rng: np.random.Generator, size: int = SIZE) -> tuple[NDArray[np.uint8], Image]:
    """Return an image, and the share of each pixel that is needle.

    Parameters
    ----------
    rng : Generator
        What draws them.
    size : int
        Width and height [px].

    Returns
    -------
    image : ndarray of uint8, shape (size, size)
        As a camera has it.
    share : ndarray of float32, shape (size, size)
        0 to 1; the shaft is cut straight at the end of its axis, whatever its bevel.
    """
    image = floor(rng, size)
    wanted = np.zeros((size, size), np.float32)
    radius = 0.5 * WIDTH * rng.uniform(*LIKE)
    pose = random_pose(rng, size, radius)
    there = rng.random() < 0.75
    if rng.random() < 0.6:
        image = draw_shadow(rng, image, pose)
    image = clutter(rng, image) if rng.random() < 0.5 else image
    if there:
        image = draw_needle(rng, image, pose)
        wanted = true_map(pose, size)
    image = clutter(rng, image) if rng.random() < 0.3 else image
    return _exposed(rng, image), wanted


def _exposed(rng: np.random.Generator, image: Image) -> NDArray[np.uint8]:
    """Return what a camera makes of brightness: blur, haze, noise, 8 bits."""
    haze = rng.uniform(0.0, 0.4) if rng.random() < 0.3 else 0.0
    image = image * (1.0 - haze) + haze * rng.uniform(30.0, 200.0)
    image = image * rng.uniform(0.6, 1.3)
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(0.35, 1.3)), np.float32)
    noise = rng.standard_normal(image.shape).astype(np.float32)
    if rng.random() < 0.4:  # resampled, or sharpened by the camera
        noise = cv2.GaussianBlur(noise, (0, 0), rng.uniform(0.4, 1.0))
        noise /= max(float(noise.std()), 1e-6)
    image = image + noise * (rng.uniform(0.3, 6.0) + rng.uniform(0.0, 0.05) * image)
    exposed = np.clip(image, 0.0, 255.0).astype(np.uint8)
    if rng.random() < 0.15:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(50, 95))]
        exposed = np.asarray(cv2.imdecode(cv2.imencode(".jpg", exposed, quality)[1], 0), np.uint8)
    return exposed
