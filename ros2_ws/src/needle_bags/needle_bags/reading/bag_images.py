"""Images in a bag, raw or compressed on `.../compressed` topics of image_transport."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from needle_bags.format.bag_writer import stamp_of
from needle_bags.reading.bag_messages import raw_as_sent, read_messages
from needle_bags.reading.bag_reader import Run
from needle_core.convert import from_ros
from needle_core.errors import UserError
from needle_core.message_types import to_nanoseconds
from needle_core.messages import Image

SIDES = ("left", "right")
TOPICS = {
    f"stereo/{side}/image_raw{ending}": side for side in SIDES for ending in ("", "/compressed")
}
"""Side of the camera, by relative topic name."""

Stamps = npt.NDArray[np.int64]


def plain_image(message: Any) -> Image:
    """Return an image message, decompressed if necessary.

    An image that cannot be decompressed has no pixels; its `encoding` is the compressed format.
    """
    if not hasattr(message, "format"):
        raw: Image = from_ros(Image, message)
        return raw
    stamp_ns, frame = to_nanoseconds(message.header.stamp), message.header.frame_id
    encoded = np.frombuffer(message.data, np.uint8)
    try:
        pixels = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED) if len(encoded) else None
    except cv2.error:  # larger than OpenCV supports
        pixels = None
    if pixels is None or pixels.ndim != 2 or pixels.dtype != np.uint8:
        return Image(stamp_ns, frame, 0, 0, str(message.format), 0, b"")
    height, width = pixels.shape
    return Image(stamp_ns, frame, height, width, "mono8", width, pixels.tobytes())


def pixels_of(image: Image, path: Path) -> npt.NDArray[np.uint8]:
    """Return a mono image's pixels (H, W).

    Raises
    ------
    UserError
        If the data do not have the declared size; `path` is the bag for the message.
    """
    size = (image.height, image.width)
    if image.step < image.width or len(image.data) != image.height * image.step:
        raise UserError(
            f"{path}: an image declares {size[0]} rows of {size[1]} pixels, but has "
            f"{len(image.data)} bytes"
        )
    rows = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)
    return rows[:, : image.width]


def exposures(run: Run) -> Stamps:
    """Return the stamps of the left camera's images [ns], in order.

    Raises
    ------
    UserError
        If the bag cannot be read.
    """
    left = {run.namespace + topic for topic, side in TOPICS.items() if side == "left"}
    sent = raw_as_sent(run.path, left.__contains__)
    return np.unique(np.array([stamp_of(message.data) for message in sent], np.int64))


def images_at(run: Run, stamps: Stamps) -> Iterator[tuple[int, str, npt.NDArray[np.uint8]]]:
    """Yield (index into `stamps`, side, mono image (H, W)) of the images with these stamps.

    Parameters
    ----------
    run : Run
        The run; its bag is read again.
    stamps : (N,) int64
        Times of exposure [ns].

    Raises
    ------
    UserError
        If the bag cannot be read.
    """
    index_of = {int(stamp): index for index, stamp in enumerate(stamps)}
    names = {run.namespace + topic: side for topic, side in TOPICS.items()}
    for topic, _, message in read_messages(run.path, lambda name: name in names):
        index = index_of.get(to_nanoseconds(message.header.stamp))
        if index is None:
            continue
        image = plain_image(message)
        if image.encoding == "mono8":
            yield index, names[topic], pixels_of(image, run.path)
