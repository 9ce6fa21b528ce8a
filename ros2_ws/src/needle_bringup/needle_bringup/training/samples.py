"""Samples for the needle net, and the effects of a camera on their images.

A sample has an image, a background, and the position of shaft and end. The effects of camera and
codec are the same for all images of one camera.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Bytes = NDArray[np.uint8]

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
    """Patch with its border.

    Attributes
    ----------
    image : ndarray of uint8, shape (CANVAS, CANVAS)
        Camera image.
    background : ndarray of uint8, shape (CANVAS, CANVAS), or None
        The same view with less of the needle, none of it, or sometimes more; None if unknown.
    share : ndarray of uint8, shape (CANVAS, CANVAS)
        255 times the share of each pixel that belongs to the shaft, cut straight at its end.
    end : ndarray, shape (2,)
        Column and row of the end [px]; NaN if there is none.
    """

    image: NDArray[np.uint8]
    background: NDArray[np.uint8] | None
    share: NDArray[np.uint8]
    end: NDArray[np.float64]


def random_width(rng: np.random.Generator) -> float:
    """Return a random needle width, log-uniform [px]."""
    return float(np.exp(rng.uniform(*np.log(WIDTHS))))


@dataclasses.dataclass(frozen=True)
class CameraEffects:
    """Effects of the optics, sensor and codec of a camera, in order of application.

    Attributes
    ----------
    haze, haze_level : float
        Share of stray light, and its brightness.
    gamma, gain : float
        Gamma and gain of the brightness.
    blur_px : float
        Sigma of the optical blur [px].
    shrink : float
        Factor by which the image is reduced before it is enlarged again; 1 for none.
    noise, noise_share : float
        Sigma of the sensor noise, in grey levels and relative to the brightness.
    noise_blur_px : float
        Correlation length of the noise [px]; 0 for white noise.
    denoise : str
        "median", "bilateral" or "".
    sharpen, sharpen_px : float
        Gain and blur sigma [px] of the unsharp mask.
    quality : int
        JPEG quality; 0 for no compression.
    """

    haze: float
    haze_level: float
    gamma: float
    gain: float
    blur_px: float
    shrink: float
    noise: float
    noise_share: float
    noise_blur_px: float
    denoise: str
    sharpen: float
    sharpen_px: float
    quality: int

    @classmethod
    def draw(cls, rng: np.random.Generator) -> CameraEffects:
        """Return a random camera; half of them have noise below two grey levels."""

        def sometimes(chance: float, low: float, high: float, otherwise: float) -> float:
            return float(rng.uniform(low, high)) if rng.random() < chance else otherwise

        blurs = ((0.3, 1.0), (0.3, 1.0), (0.3, 1.0), (0.8, 1.6), (0.8, 1.6), (1.5, 2.5))
        return cls(
            haze=sometimes(0.3, 0.0, 0.45, 0.0),
            haze_level=float(rng.uniform(30.0, 200.0)),
            gamma=sometimes(0.4, 0.6, 1.5, 1.0),
            gain=sometimes(0.6, 0.8, 1.2, float(np.exp(rng.uniform(*np.log((0.3, 1.5)))))),
            blur_px=float(rng.uniform(*blurs[rng.integers(len(blurs))])),
            shrink=sometimes(0.2, 0.45, 0.95, 1.0),
            noise=14.0 * float(rng.uniform()) ** 3,
            noise_share=sometimes(0.5, 0.0, 0.04, 0.0),
            noise_blur_px=sometimes(0.3, 0.4, 1.0, 0.0),
            denoise=str(rng.choice(["", "", "", "", "median", "bilateral"])),
            sharpen=sometimes(0.25, 0.2, 1.5, 0.0),
            sharpen_px=float(rng.uniform(0.8, 2.0)),
            quality=int(sometimes(0.4, 10.0, 95.0, 0.0)),
        )

    def apply(self, rng: np.random.Generator, image: Image) -> Bytes:
        """Return the image that this camera takes.

        Parameters
        ----------
        rng : Generator
            Generator of the noise.
        image : ndarray of float32, shape (height, width)
            Brightness, 0 to 255 and beyond.
        """
        size = image.shape[::-1]
        values = image * np.float32(1.0 - self.haze) + np.float32(self.haze * self.haze_level)
        if self.gamma != 1.0:
            values = 255.0 * (values / 255.0) ** np.float32(self.gamma)
        values = cv2.GaussianBlur(values * np.float32(self.gain), (0, 0), self.blur_px)
        if self.shrink < 1.0:
            smaller = [max(round(self.shrink * side), 8) for side in size]
            values = cv2.resize(values, smaller, interpolation=cv2.INTER_AREA)
        values = values + self._noise(rng, values)
        photo: Bytes = np.clip(np.rint(values), 0.0, 255.0).astype(np.uint8)
        photo = self._coded(self._sharpened(self._denoised(photo)))
        if self.shrink < 1.0:
            photo = np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_LINEAR), np.uint8)
        return photo

    def _noise(self, rng: np.random.Generator, values: Image) -> Image:
        noise = rng.standard_normal(values.shape, np.float32)
        if self.noise_blur_px > 0.0:
            noise = np.asarray(cv2.GaussianBlur(noise, (0, 0), self.noise_blur_px), np.float32)
            noise /= max(float(noise.std()), 1e-6)
        level = np.float32(self.noise) + np.float32(self.noise_share) * np.minimum(values, 255.0)
        return np.asarray(noise * level, np.float32)

    def _denoised(self, photo: Bytes) -> Bytes:
        match self.denoise:
            case "median":
                smooth = cv2.medianBlur(photo, 3)
            case "bilateral":
                smooth = cv2.bilateralFilter(photo, 5, 6.0 + 3.0 * self.noise, 2.0)
            case _:
                smooth = photo
        return np.asarray(smooth, np.uint8)

    def _sharpened(self, photo: Bytes) -> Bytes:
        if self.sharpen == 0.0:
            return photo
        blurred = cv2.GaussianBlur(photo, (0, 0), self.sharpen_px)
        return np.asarray(
            cv2.addWeighted(photo, 1.0 + self.sharpen, blurred, -self.sharpen, 0.0), np.uint8
        )

    def _coded(self, photo: Bytes) -> Bytes:
        if self.quality == 0:
            return photo
        code = cv2.imencode(".jpg", photo, [cv2.IMWRITE_JPEG_QUALITY, self.quality])[1]
        return np.asarray(cv2.imdecode(code, cv2.IMREAD_GRAYSCALE), np.uint8)


def exposed(
    rng: np.random.Generator, image: Image, before: Image | None
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Return the camera images of a scene and its background, each with its own noise.

    Parameters
    ----------
    rng : Generator
        Generator of the camera and its noise.
    image, before : ndarray of float32, shape (size, size)
        Brightness, 0 to 255 and beyond, of the scene and its background, if any.
    """
    effects = CameraEffects.draw(rng)
    photo = effects.apply(rng, image)
    if before is None:
        return photo, None
    if rng.random() < _OTHER_LIGHT:
        before = before * np.float32(rng.uniform(*_LIGHT))
    if rng.random() < _BUMPED:
        before = moved(before, rng.uniform(0.0, _BUMP_PX), rng.uniform(0.0, 2.0 * np.pi))
    if rng.random() < _OTHER_FOCUS:
        before = np.asarray(cv2.GaussianBlur(before, (0, 0), rng.uniform(*_FOCUS_PX)), np.float32)
    return photo, effects.apply(rng, before)


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
