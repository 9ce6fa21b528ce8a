"""Conversion of camera images to grey: grey, colour, YUV 4:2:2 or a Bayer pattern, 8 bits each."""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

ENCODINGS = {
    "mono8": (1, None),
    "8UC1": (1, None),
    "bgr8": (3, cv2.COLOR_BGR2GRAY),
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
    "yuyv": (2, cv2.COLOR_YUV2GRAY_YUY2),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2GRAY_YUY2),
    "uyvy": (2, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422": (2, cv2.COLOR_YUV2GRAY_UYVY),
    # OpenCV names a pattern by the second and third pixel of its second row.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2GRAY),
}
"""Bytes per pixel and OpenCV's conversion, by the names of sensor_msgs/image_encodings."""


@dataclasses.dataclass(frozen=True)
class Frame:
    """A received image: grey `pixels`, which a grey message shares, or the problem with it."""

    pixels: NDArray[np.uint8] | None
    problem: str = ""


def decoded(message: Any, side: str) -> Frame:
    """Return the brightness of an image of one side, shape (height, width).

    The message is an `Image` of needle_core, rclpy or rosbags, which have the same fields.
    """
    if message.encoding not in ENCODINGS:
        expected = "8 bits, such as mono8 or bgr8"
        return Frame(None, f"{side} image is {message.encoding!r}, expected {expected}")
    channels, conversion = ENCODINGS[message.encoding]
    height, width, length = message.height, message.width, len(message.data)
    least = width * channels
    if not 0 < height * least <= length == height * message.step:
        return Frame(
            None,
            f"{side} image has {length} bytes in rows of {message.step}, "
            f"{height} rows of {least} expected",
        )
    rows = np.frombuffer(message.data, np.uint8).reshape(height, -1)
    pixels = rows[:, :least].reshape(height, width, channels)
    if conversion is None:
        return Frame(pixels[..., 0])
    return Frame(np.asarray(cv2.cvtColor(pixels, conversion), np.uint8))
