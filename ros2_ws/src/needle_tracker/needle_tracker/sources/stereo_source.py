"""Sources of image pairs: two cameras, two folders or two video files; and their port."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np

from needle_core.component import Batch, PortChange
from needle_core.errors import UserError
from needle_tracker.sources.image_files import Image, Sizes, open_pairs, size_problem

LOST_AFTER = 20  # consecutive failed reads of the cameras


@dataclasses.dataclass(frozen=True)
class StampedPair:
    """A pair of grey images and their stamps [ns of the given clock]."""

    left: Image
    right: Image
    left_stamp: int
    right_stamp: int


@dataclasses.dataclass(frozen=True)
class EndOfRecording:
    """End of a recording.

    Attributes
    ----------
    missing : str
        Missing frames, as text; empty if the recording is complete.
    """

    missing: str = ""


def open_source(
    names: tuple[str, str], sizes: Sizes, rate: float, clock: Callable[[], int], *, loop: bool
) -> CameraPair | RecordedPairs:
    """Open cameras or a recording.

    Parameters
    ----------
    names : pair of str
        Left and right: device number or `/dev/...`, folder, or video file.
    sizes : dict of str to (int, int)
        Required width and height of the images of each side [px].
    rate : float
        Pairs per second that are requested from cameras.
    clock : callable
        Returns the time for the stamps [ns].
    loop : bool
        Whether a recording restarts at its end.

    Raises
    ------
    UserError
        A source is missing, cannot be opened, or has another size than the calibration.
    """
    for side, name in zip(sizes, names, strict=True):
        if not name:
            raise UserError(f"{side} is empty: a device number, /dev/videoN, a folder or a video")
    left, right = names
    # A camera is a number or a path below /dev/.
    are_cameras = {name.isdecimal() or name.startswith("/dev/") for name in names}
    if len(are_cameras) > 1:
        raise UserError(
            f"left = {left!r} and right = {right!r}: one is a camera, the other a recording"
        )
    if are_cameras == {False}:
        return RecordedPairs(names, sizes, clock, loop=loop)
    if left == right:
        raise UserError(f"left and right are the same camera, {left!r}")
    return CameraPair(names, sizes, rate, clock)


class CameraPair:
    """Two cameras, read by OpenCV.

    Both images are grabbed before the first is decoded: decoding takes milliseconds, which would
    separate the two exposures. The stamp of an image is the time right after its grab.

    Parameters
    ----------
    names, sizes, rate, clock
        As for `open_source`.
    open_capture : callable
        Opens a device by its name; by default with OpenCV.
    """

    def __init__(
        self,
        names: tuple[str, str],
        sizes: Sizes,
        rate: float,
        clock: Callable[[], int],
        open_capture: Callable[[str], cv2.VideoCapture] | None = None,
    ) -> None:
        self._clock, self._sizes = clock, sizes
        self._failed = 0
        self._captures: dict[str, cv2.VideoCapture] = {}
        opened = open_capture or _open_device
        for side, name in zip(sizes, names, strict=True):
            if name.startswith("/dev/") and not Path(name).exists():
                raise UserError(f"{side} camera {name} does not exist")
            capture = opened(name)
            if not capture.isOpened():
                self.close()
                raise UserError(f"{side} camera {name} cannot be opened: missing, or in use")
            self._captures[side] = capture
            for key, value in (
                (cv2.CAP_PROP_FRAME_WIDTH, sizes[side][0]),
                (cv2.CAP_PROP_FRAME_HEIGHT, sizes[side][1]),
                (cv2.CAP_PROP_FPS, rate),
                # An old frame from a queue would get a new stamp.
                (cv2.CAP_PROP_BUFFERSIZE, 1),
            ):
                capture.set(key, value)

    def next(self) -> StampedPair | None:
        """Return the next pair; None if a camera failed.

        Raises
        ------
        UserError
            Cameras that were disconnected, or images of another size.
        """
        stamps, grabbed = {}, True
        for side, capture in self._captures.items():
            grabbed = bool(capture.grab()) and grabbed
            stamps[side] = self._clock()
        left, right = (self._retrieve(side) if grabbed else None for side in self._captures)
        if left is None or right is None:
            self._failed += 1
            if self._failed >= LOST_AFTER:
                raise UserError(f"the cameras gave no pair {LOST_AFTER} times in a row: unplugged?")
            return None
        self._failed = 0
        for (side, expected), image in zip(self._sizes.items(), (left, right), strict=True):
            if problem := size_problem(side, image.shape[::-1], expected):
                raise UserError(problem)
        return StampedPair(left, right, stamps["left"], stamps["right"])

    def close(self) -> None:
        """Close the cameras."""
        for capture in self._captures.values():
            capture.release()

    def _retrieve(self, side: str) -> Image | None:
        good, frame = self._captures[side].retrieve()
        if not good or frame is None:
            return None
        grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        return np.ascontiguousarray(grey, dtype=np.uint8)


class RecordedPairs:
    """Two folders of images, or two videos, one pair after the other.

    Both images of a pair have one stamp: the time of the request.

    Parameters
    ----------
    names, sizes, clock, loop
        As for `open_source`.
    """

    def __init__(
        self, names: tuple[str, str], sizes: Sizes, clock: Callable[[], int], *, loop: bool
    ) -> None:
        self._clock, self._sizes, self._loop = clock, sizes, loop
        self._pairs = open_pairs(Path(names[0]), Path(names[1])).refuse_unpaired()
        # Reject a recording of another size before its first pair is published.
        next(self._read())
        self._events = self._read()

    def next(self) -> StampedPair | EndOfRecording | None:
        """Return the next pair; None if one of its images cannot be read.

        Raises
        ------
        UserError
            Images of another size.
        """
        return next(self._events)

    def close(self) -> None:
        """Close the files."""
        self._events = iter(())

    def _read(self) -> Iterator[StampedPair | EndOfRecording | None]:
        repeat = True
        while repeat:
            repeat = False
            for pair in self._pairs:
                stamp = self._clock()
                if pair.left is None or pair.right is None:
                    yield None
                    continue
                if problem := pair.problem(self._sizes):
                    raise UserError(f"{pair.name}: {problem}")
                repeat = self._loop
                yield StampedPair(pair.left, pair.right, stamp, stamp)
        while True:
            yield EndOfRecording(self._pairs.missing)


def _open_device(name: str) -> cv2.VideoCapture:
    # Failures are reported in one line; silence the messages of OpenCV.
    opencv = cast(Any, cv2)
    # OpenCV 5 moved the function.
    logging = opencv if hasattr(opencv, "setLogLevel") else opencv.utils.logging
    logging.setLogLevel(0)
    if name.isdecimal():
        return cv2.VideoCapture(int(name), cv2.CAP_V4L2)
    return cv2.VideoCapture(name, cv2.CAP_V4L2)


Event = StampedPair | EndOfRecording | None
"""Result of a read of a source."""


class PairPort:
    """Port of a source: a thread reads the next pair on each request.

    Parameters
    ----------
    source : CameraPair or RecordedPairs
        An open source, closed with the port.
    """

    def __init__(self, source: CameraPair | RecordedPairs) -> None:
        self._source = source
        self._reader = ThreadPoolExecutor(1, "pairs")

    def open(self, arrive: Callable[[Batch | PortChange], None]) -> None:
        """Set the callback that the thread calls with results."""
        self._arrive = arrive

    def send(self, batch: tuple[Any, ...]) -> None:
        """Request the next pair."""
        self._reader.submit(self._source.next).add_done_callback(self._on_read)

    def close(self) -> None:
        """Close the source, after the current read."""
        self._reader.shutdown()
        self._source.close()

    def _on_read(self, read: Future[Event]) -> None:
        error = read.exception()
        if isinstance(error, UserError):
            self._arrive(PortChange(str(error)))
        else:
            # Any other error is raised in the node and ends it.
            self._arrive(lambda: (read.result(),))
