"""Samples for the needle net: image, background, and position of shaft and end."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_bringup.training.camera_effects import CameraEffects

Image = NDArray[np.float32]

SIZE = 112
"""Width and height of a patch [px]."""
BORDER = 32
"""Margin around a patch, for the brightness of its surroundings [px]."""
CANVAS = SIZE + 2 * BORDER
"""Width and height of the images [px]."""
WIDTHS = (2.2, 10.0)
"""Range of needle widths [px]."""
WITH_BACKGROUND = 0.6
"""Probability of a background."""
_BUMPED, _BUMP_PX = 0.3, 1.5  # probability and range of a camera shift since the background
_OTHER_LIGHT, _LIGHT = 0.5, (0.75, 1.3)  # probability and range of a brightness change

_OTHER_FOCUS, _FOCUS_PX = 0.1, (0.5, 1.2)  # probability and range of an additional blur


@dataclasses.dataclass(frozen=True, eq=False)
class Sample:
    """A patch with its border.

    Attributes
    ----------
    image : ndarray of uint8, shape (CANVAS, CANVAS)
        Camera image.
    background : ndarray of uint8, shape (CANVAS, CANVAS), or None
        The same view with less of the needle, none, or sometimes more; None: unknown.
    share : ndarray of uint8, shape (CANVAS, CANVAS)
        255 times the share of each pixel that belongs to the shaft, cut straight at its end.
    end : ndarray, shape (2,)
        Column and row of the end [px]; NaN without one.
    width_px : float
        Width of the needle [px], also without a needle.
    """

    image: NDArray[np.uint8]
    background: NDArray[np.uint8] | None
    share: NDArray[np.uint8]
    end: NDArray[np.float64]
    width_px: float


def random_width(rng: np.random.Generator) -> float:
    """Return a random needle width, log-uniform [px]."""
    return float(np.exp(rng.uniform(*np.log(WIDTHS))))


def exposed(
    rng: np.random.Generator, image: Image, before: Image | None
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Return the camera images of a scene and its background, each with its own noise.

    Parameters
    ----------
    rng : Generator
        Generator of the camera and its noise.
    image, before : ndarray of float32, shape (size, size)
        Brightness, 0 to 255 and beyond; no background if `before` is None.
    """
    effects = CameraEffects.draw(rng)
    seen = effects.apply(rng, image)
    if before is None:
        return seen, None
    if rng.random() < _OTHER_LIGHT:
        before = before * np.float32(rng.uniform(*_LIGHT))
    if rng.random() < _BUMPED:
        before = moved(before, rng.uniform(0.0, _BUMP_PX), rng.uniform(0.0, 2.0 * np.pi))
    if rng.random() < _OTHER_FOCUS:
        before = np.asarray(cv2.GaussianBlur(before, (0, 0), rng.uniform(*_FOCUS_PX)), np.float32)
    return seen, effects.apply(rng, before)


def moved(image: Image, distance: float, angle: float) -> Image:
    """Return an image shifted by a distance in a direction [px, rad]."""
    to = np.array(
        [[1.0, 0.0, distance * np.cos(angle)], [0.0, 1.0, distance * np.sin(angle)]], np.float64
    )
    size = image.shape[::-1]
    return np.asarray(
        cv2.warpAffine(image, to, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT).clip(
            min=0.0
        ),
        np.float32,
    )
