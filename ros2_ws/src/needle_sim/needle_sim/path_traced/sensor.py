"""From light to grey levels: haze's glow, the lens's blur, blooming, exposure and noise."""

from __future__ import annotations

import cv2
import numpy as np

from needle_sim.camera.optics import FloatImage
from needle_sim.camera.view import GreyImage
from needle_sim.path_traced.appearance import Appearance

_FULL = 255.0
_HAZE_BLUR_PX = 9.0
_BLOOM_BLUR_PX = 2.5
_BLOOM_ALONG_PX = 14.0
# Beyond this, more light makes no wider bloom: wells overflow into the drain.
_BRIGHTEST = 6.0 * _FULL


def flicker(look: Appearance, number: int) -> float:
    """Return by what the light of an exposure is stronger, for both cameras."""
    rng = np.random.default_rng([look.seed, number, 40])
    return float(np.exp(look.flicker * rng.standard_normal()))


def grey_image(
    light: FloatImage, look: Appearance, black: float, rng: np.random.Generator
) -> GreyImage:
    """Return what the sensor makes of light.

    Parameters
    ----------
    light : ndarray of float32, shape (rows, columns)
        In grey levels, as far above full scale as it is.
    look : Appearance
        Haze, blur, blooming, noise.
    black : float
        What the sensor says of no light [grey levels].
    rng : numpy.random.Generator
        For the noise.
    """
    image = np.minimum(light, _BRIGHTEST).astype(np.float32)
    if look.haze > 0.0:
        # What is scattered forwards arrives beside its place: it takes contrast from what is small.
        glow = cv2.GaussianBlur(image, (0, 0), _HAZE_BLUR_PX)
        image += 0.5 * look.haze * (glow - image)
    image = cv2.GaussianBlur(image, (0, 0), look.blur_px)
    if look.bloom > 0.0:
        beyond = np.maximum(image - _FULL, 0.0)
        around = cv2.GaussianBlur(beyond, (0, 0), _BLOOM_BLUR_PX)
        column = cv2.GaussianBlur(beyond, (1, 0), sigmaX=1e-3, sigmaY=_BLOOM_ALONG_PX)
        image += look.bloom * (6.0 * around + 6.0 * column)
    image += black
    spread = np.sqrt(
        look.noise**2 + look.shot_noise**2 * np.clip(image, 0.0, _FULL) / _FULL, dtype=np.float32
    )
    image += spread * rng.standard_normal(image.shape, dtype=np.float32)
    return np.asarray(np.clip(np.rint(image), 0.0, _FULL), dtype=np.uint8)
