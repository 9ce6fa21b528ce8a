"""Conversion of camera images to grey: grey, colour, YUV 4:2:2 or a Bayer pattern, 8 bits each.

The names are those of sensor_msgs/image_encodings.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

_GREY = ("mono8", "8UC1")
_COLOUR = {
    "bgr8": (3, cv2.COLOR_BGR2GRAY),
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
}
# Brightness is every other byte, starting at this one.
_YUV = {"yuyv": 0, "yuv422_yuy2": 0, "uyvy": 1, "yuv422": 1}
# OpenCV names a pattern by the second and third pixel of its second row.
_BAYER = {
    "bayer_rggb8": cv2.COLOR_BayerBG2GRAY,
    "bayer_bggr8": cv2.COLOR_BayerRG2GRAY,
    "bayer_gbrg8": cv2.COLOR_BayerGR2GRAY,
    "bayer_grbg8": cv2.COLOR_BayerGB2GRAY,
}
ENCODINGS = (*_GREY, *_COLOUR, *_YUV, *_BAYER)
"""Supported encodings."""
SUPPORTED = "8 bits, such as mono8 or bgr8"
"""Supported encodings, in short."""


def bytes_per_pixel(encoding: str) -> int:
    """Return the bytes of one pixel in an encoding of `ENCODINGS`."""
    if encoding in _COLOUR:
        return _COLOUR[encoding][0]
    return 2 if encoding in _YUV else 1


def grey_image(rows: NDArray[np.uint8], width: int, encoding: str) -> Image:
    """Return the brightness of an image.

    Parameters
    ----------
    rows : ndarray of uint8, shape (height, step)
        Bytes of the image, row by row; padding after the pixels of a row is ignored.
    width : int
        Width of the image [px].
    encoding : str
        One of `ENCODINGS`.

    Returns
    -------
    ndarray of uint8, shape (height, width)
        Grey image, which shares memory with a grey input.
    """
    pixels = rows[:, : width * bytes_per_pixel(encoding)]
    if encoding in _COLOUR:
        channels, code = _COLOUR[encoding]
        return np.asarray(cv2.cvtColor(pixels.reshape(len(rows), width, channels), code), np.uint8)
    if encoding in _YUV:
        return pixels[:, _YUV[encoding] :: 2]
    if encoding in _BAYER:
        return np.asarray(cv2.cvtColor(pixels, _BAYER[encoding]), np.uint8)
    return pixels
