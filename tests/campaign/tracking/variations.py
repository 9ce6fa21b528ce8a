"""What may be otherwise than the tracker expects: its settings, the stage, the cameras' images."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
_NOISE = 12.0  # grey levels
_QUALITY = 20  # of JPEG
_GAIN = 0.4


@dataclasses.dataclass(frozen=True)
class Variation:
    """One thing that is otherwise.

    Attributes
    ----------
    name : str
        As a person reads it.
    width : float
        Needle width that is told, over the true one.
    zero : float
        Added to the insertion that is told [m].
    seen : callable
        Image and generator of noise in, image out.
    """

    name: str
    width: float = 1.0
    zero: float = 0.0
    seen: Callable[[Image, np.random.Generator], Image] = lambda image, _: image


def _blurred(sigma: float) -> Callable[[Image, np.random.Generator], Image]:
    return lambda image, _: np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8)


def _coded(image: Image, _: np.random.Generator) -> Image:
    code = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
    return np.asarray(cv2.imdecode(code, cv2.IMREAD_GRAYSCALE), np.uint8)


def _noisy(image: Image, rng: np.random.Generator) -> Image:
    values = image + rng.normal(0.0, _NOISE, image.shape)
    return np.asarray(np.clip(np.rint(values), 0.0, 255.0), np.uint8)


def _dim(image: Image, _: np.random.Generator) -> Image:
    return np.asarray(np.rint(_GAIN * image), np.uint8)


AS_TRACED = Variation("as traced")
VARIATIONS = (
    Variation("width told 0.7 times", width=0.7),
    Variation("width told 1.3 times", width=1.3),
    Variation("stage 1 mm too long", zero=1e-3),
    Variation("stage 1 mm too short", zero=-1e-3),
    Variation("blur of 1 px", seen=_blurred(1.0)),
    Variation("blur of 2 px", seen=_blurred(2.0)),
    Variation("JPEG 20", seen=_coded),
    Variation("noise 12", seen=_noisy),
    Variation("gain 0.4", seen=_dim),
)
