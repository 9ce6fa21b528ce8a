"""Samples for the needle net: an image, the same view before, and where shaft and end are."""

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
"""Margin around a patch: brightness is judged against the surroundings [px]."""
CANVAS = SIZE + 2 * BORDER
"""Width and height of the images [px]."""
WIDTHS = (2.2, 10.0)
"""Of the needles [px]."""
WITH_BACKGROUND = 0.6
"""So often a background is given."""
_BUMPED, _BUMP_PX = 0.3, 1.5  # so often and so far the camera was moved since the background
_OTHER_LIGHT, _LIGHT = 0.5, (0.75, 1.3)  # so often and so much brighter it was

_OTHER_FOCUS, _FOCUS_PX = 0.1, (0.5, 1.2)  # so often and so much more it was blurred


@dataclasses.dataclass(frozen=True, eq=False)
class Sample:
    """One patch with its border.

    Attributes
    ----------
    image : ndarray of uint8, shape (CANVAS, CANVAS)
        As a camera has it.
    background : ndarray of uint8, shape (CANVAS, CANVAS), or None
        The same view with less of the needle, none, or sometimes more; None: not known.
    share : ndarray of uint8, shape (CANVAS, CANVAS)
        255 times the share of each pixel that is shaft, cut straight at the end of its axis.
    end : ndarray, shape (2,)
        Where that is, column and row [px]; NaN where there is none.
    width_px : float
        Of the needle [px]; what it would be where there is none.
    """

    image: NDArray[np.uint8]
    background: NDArray[np.uint8] | None
    share: NDArray[np.uint8]
    end: NDArray[np.float64]
    width_px: float


def random_width(rng: np.random.Generator) -> float:
    """Return a needle's width, every octave as often [px]."""
    return float(np.exp(rng.uniform(*np.log(WIDTHS))))


def exposed(
    rng: np.random.Generator, image: Image, before: Image | None
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Return what one camera makes of a scene now and before, each with noise of its own.

    Parameters
    ----------
    rng : Generator
        What draws the camera and its noise.
    image, before : ndarray of float32, shape (size, size)
        Brightness, 0 to 255 and beyond; no background where `before` is None.
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
    """Return an image moved by a distance in a direction [px, rad]."""
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
