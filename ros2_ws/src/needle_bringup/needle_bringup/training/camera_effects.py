"""Random effects of cameras and codecs, equal for all images of one camera."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Bytes = NDArray[np.uint8]


@dataclasses.dataclass(frozen=True)
class CameraEffects:
    """Optics, sensor and codec of a camera, in the order of their effect.

    Attributes
    ----------
    haze, haze_level : float
        Share of stray light, and its brightness.
    gamma, gain : float
        Gamma and gain of the brightness.
    blur_px : float
        Sigma of the blur of the optics [px].
    shrink : float
        Factor by which the image is reduced, and enlarged again; 1: none.
    noise, noise_share : float
        Sigma of the sensor noise, in grey levels and as a share of the brightness.
    noise_blur_px : float
        Correlation length of the noise [px]; 0: white.
    denoise : str
        "median", "bilateral" or "".
    sharpen, sharpen_px : float
        Gain and blur sigma [px] of the unsharp mask.
    quality : int
        JPEG quality; 0: no compression.
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
        """Return a random camera; half of all noise is below two grey levels."""

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
        """Return an image of this camera.

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
        seen: Bytes = np.clip(np.rint(values), 0.0, 255.0).astype(np.uint8)
        seen = self._coded(self._sharpened(self._denoised(seen)))
        if self.shrink < 1.0:
            seen = np.asarray(cv2.resize(seen, size, interpolation=cv2.INTER_LINEAR), np.uint8)
        return seen

    def _noise(self, rng: np.random.Generator, values: Image) -> Image:
        noise = rng.standard_normal(values.shape, np.float32)
        if self.noise_blur_px > 0.0:
            noise = np.asarray(cv2.GaussianBlur(noise, (0, 0), self.noise_blur_px), np.float32)
            noise /= max(float(noise.std()), 1e-6)
        level = np.float32(self.noise) + np.float32(self.noise_share) * np.minimum(values, 255.0)
        return np.asarray(noise * level, np.float32)

    def _denoised(self, seen: Bytes) -> Bytes:
        match self.denoise:
            case "median":
                smooth = cv2.medianBlur(seen, 3)
            case "bilateral":
                smooth = cv2.bilateralFilter(seen, 5, 6.0 + 3.0 * self.noise, 2.0)
            case _:
                smooth = seen
        return np.asarray(smooth, np.uint8)

    def _sharpened(self, seen: Bytes) -> Bytes:
        if self.sharpen == 0.0:
            return seen
        blurred = cv2.GaussianBlur(seen, (0, 0), self.sharpen_px)
        return np.asarray(
            cv2.addWeighted(seen, 1.0 + self.sharpen, blurred, -self.sharpen, 0.0), np.uint8
        )

    def _coded(self, seen: Bytes) -> Bytes:
        if self.quality == 0:
            return seen
        code = cv2.imencode(".jpg", seen, [cv2.IMWRITE_JPEG_QUALITY, self.quality])[1]
        return np.asarray(cv2.imdecode(code, cv2.IMREAD_GRAYSCALE), np.uint8)
