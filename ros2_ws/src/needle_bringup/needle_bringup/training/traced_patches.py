"""Patches cut from path-traced images, turned, scaled and exposed anew at random."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_bringup.training.patches import LIKE, SIZE, WIDTH
from needle_bringup.training.traced_scenes import TracedScene
from needle_tracker.image.background import Background

Array = NDArray[np.float64]

BORDER = 32
"""Margin rendered around a patch [px]."""
_AT_END, _ON_SHAFT = 0.55, 0.3  # so often there; else anywhere
_NEW = 0.35  # so often what has come since an earlier image
_BESIDE_PX = 38.0  # so far from the middle may be what a patch is about
_SMALLER, _BLUR = 0.8, 0.45  # images made smaller than that are blurred, by so many new pixels


def traced_patch(
    rng: np.random.Generator, scene: TracedScene
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return an image, and the share of each pixel that is shaft.

    Parameters
    ----------
    rng : Generator
        What chooses.
    scene : TracedScene
        Where from.

    Returns
    -------
    image : ndarray of uint8, shape (SIZE + 2 BORDER, SIZE + 2 BORDER)
        The patch and what is around it: brightness is judged against that.
    share : ndarray of float32, shape (SIZE, SIZE)
        0 to 1, of the patch.
    """
    i = int(rng.integers(len(scene.images)))
    image, share = scene.images[i], scene.shares[i]
    if i > 1 and rng.random() < _NEW:
        image, share = new_part(scene, i, int(rng.choice(np.arange(i % 2, i, 2))))
    scale = WIDTH * rng.uniform(*LIKE) / scene.widths_px[i]
    angle = rng.uniform(0.0, 2.0 * np.pi) if rng.random() < 0.4 else 0.0
    place = _place(rng, scene, i) + rng.uniform(-_BESIDE_PX, _BESIDE_PX, 2) / scale
    if scale < _SMALLER:
        image, share = (cv2.GaussianBlur(each, (0, 0), _BLUR / scale) for each in (image, share))
    size = SIZE + 2 * BORDER
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    to = np.column_stack([turn, np.full(2, 0.5 * (size - 1)) - turn @ place])
    cut = cv2.warpAffine(image, to, (size, size), borderMode=cv2.BORDER_REFLECT)
    wanted = cv2.warpAffine(share, to, (size, size))[BORDER:-BORDER, BORDER:-BORDER]
    return _exposed_anew(rng, cut), wanted.astype(np.float32) / np.float32(255.0)


def new_part(scene: TracedScene, i: int, k: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return what one image has beside an earlier one of its camera, and the shaft in that.

    Parameters
    ----------
    scene : TracedScene
        Where from.
    i, k : int
        The image, and the earlier one. Where nothing is gained the image itself is returned.
    """
    image, share = scene.images[i], scene.shares[i]
    difference = Background(scene.images[k], np.zeros(2), None).difference(image)
    if difference is None:
        return image, share
    return difference, np.asarray(cv2.subtract(share, scene.shares[k]), np.uint8)


def _place(rng: np.random.Generator, scene: TracedScene, i: int) -> Array:
    """Return what a patch of an image is about [px]."""
    chance, end = rng.random(), scene.ends[i]
    if chance < _AT_END and np.isfinite(end).all():
        return np.asarray(end)
    rows, columns = np.nonzero(scene.shares[i] > 128)
    if chance < _AT_END + _ON_SHAFT and len(rows):
        k = int(rng.integers(len(rows)))
        return np.array([columns[k], rows[k]], np.float64)
    height, width = scene.images.shape[1:]
    return np.asarray(rng.uniform(0.0, 1.0, 2) * [width, height])


def _exposed_anew(rng: np.random.Generator, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image with another gamma, blur and noise."""
    seen = image.astype(np.float32)
    if rng.random() < 0.5:
        seen = 255.0 * (seen / 255.0) ** np.float32(rng.uniform(0.6, 1.5))
    if rng.random() < 0.4:
        seen = np.asarray(cv2.GaussianBlur(seen, (0, 0), rng.uniform(0.3, 1.0)), np.float32)
    seen += (rng.standard_normal(seen.shape) * rng.uniform(0.0, 4.0)).astype(np.float32)
    return np.clip(seen, 0.0, 255.0).astype(np.uint8)
