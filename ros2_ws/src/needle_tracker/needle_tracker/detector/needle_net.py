"""Neural network that maps an image to the probability of shaft and the intensity of ends.

`scripts/train_needle_map` trains the weights (`needle_net.onnx`) on needles of 2 to 9 px. The input
channels are the brightness relative to the surroundings, so that lighting and floor matter little,
and the background: the same view with less needle in it.
"""

from __future__ import annotations

from importlib.resources import files

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Map = NDArray[np.float32]

MAX_WIDTH_PX = 7.0
"""Width of a needle above which the image is halved [px]; the training has up to 9 px."""
MARGIN_PX = 20
"""Context around a window that is passed to the network [px]: half the surroundings."""
_SURROUNDINGS_PX = 2 * MARGIN_PX + 1  # side of the square of the local mean, as in training
_DARK_NOISE, _CLIP = 2.0, 4.0  # [grey levels], [standard deviations], as in training
_MULTIPLE = 4  # the network halves its input twice


def normalized(image: Image) -> Map:
    """Return brightness relative to the local mean, in local standard deviations.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width)

    Returns
    -------
    ndarray of float32, shape (height, width)
    """
    size = (_SURROUNDINGS_PX, _SURROUNDINGS_PX)
    values = image.astype(np.float32)
    values -= cv2.blur(values, size, borderType=cv2.BORDER_REFLECT)
    # Rounding can make the variance of a flat image negative.
    variance = np.maximum(cv2.blur(values * values, size, borderType=cv2.BORDER_REFLECT), 0.0)
    return np.asarray(
        np.clip(values / (np.sqrt(variance) + _DARK_NOISE), -_CLIP, _CLIP), np.float32
    )


class NeedleNet:
    """The trained network, run by OpenCV.

    Parameters
    ----------
    weights : bytes or None
        Content of an ONNX file; None: the installed weights.
    """

    def __init__(self, weights: bytes | None = None) -> None:
        if weights is None:
            weights = (files("needle_tracker") / "detector" / "needle_net.onnx").read_bytes()
        self._net = cv2.dnn.readNetFromONNX(np.frombuffer(weights, np.uint8))

    def evidence(self, image: Map, background: Map | None) -> tuple[Map, Map]:
        """Return the network's maps of an image.

        Parameters
        ----------
        image : ndarray of float32, shape (height, width)
            Image from `normalized`.
        background : ndarray of float32, shape (height, width), or None
            The same view with less needle, from `normalized`; None if unknown.

        Returns
        -------
        shaft : ndarray of float32, shape (height, width)
            Probability that a pixel shows the shaft.
        ends : ndarray of float32, shape (height, width)
            Expected number of needle ends in each pixel, which may be summed over an area.
        """
        height, width = image.shape
        padded = np.zeros((1, 2, _padded_size(height), _padded_size(width)), np.float32)
        padded[0, 0, :height, :width] = image
        if background is not None:
            padded[0, 1, :height, :width] = background
        self._net.setInput(padded)
        shaft, log_ends = self._net.forward(["shaft", "end"])
        return shaft[0, 0, :height, :width], np.exp(log_ends[0, 0, :height, :width])


def _padded_size(size: int) -> int:
    return -(-size // _MULTIPLE) * _MULTIPLE
