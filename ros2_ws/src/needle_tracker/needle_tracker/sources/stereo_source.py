"""Sources of image pairs: two cameras, two folders or two video files."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol, cast

import cv2
import numpy as np

from needle_core.errors import UserError
from needle_tracker.sources.image_files import Image, Sizes, open_pairs, size_problem

# A camera that gives nothing for so many tries in a row is gone.
LOST_AFTER = 20


@dataclasses.dataclass(frozen=True)
class StampedPair:
    """A pair of grey images and when each was taken [ns of the clock given]."""

    left: Image
    right: Image
    left_stamp: int
    right_stamp: int


@dataclasses.dataclass(frozen=True)
class EndOfRecording:
    """A recording has no further pair.

    Attributes
    ----------
    missing : str
        Frames that it lacked; empty where nothing is missing.
    """

    missing: str = ""


class StereoSource(Protocol):
    """Gives one pair after the other."""

    def next(self) -> StampedPair | EndOfRecording | None:
        """Return the next pair; None where this one could not be read.

        Raises
        ------
        UserError
            A source that is gone, or images of another size.
        """

    def close(self) -> None:
        """Let go of devices and files."""


def open_source(
    names: tuple[str, str], sizes: Sizes, rate: float, clock: Callable[[], int], *, loop: bool
) -> StereoSource:
    """Open cameras or a recording.

    Parameters
    ----------
    names : pair of str
        Left and right: device number or `/dev/...`, folder, or video file.
    sizes : dict of str to (int, int)
        Width and height that each side's images must have [px].
    rate : float
        Pairs a second that cameras are asked for.
    clock : callable
        Returns the time [ns] that images are stamped with.
    loop : bool
        Whether a recording begins again at its end.

    Raises
    ------
    UserError
        Something is missing, cannot be opened, or is not of the calibration's size.
    """
    for side, name in zip(sizes, names, strict=True):
        if not name:
            raise UserError(f"{side} is empty: a device number, /dev/videoN, a folder or a video")
    left, right = names
    # A camera is a number, or below /dev/.
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
    """Two cameras through OpenCV.

    Both are grabbed, one right after the other, and only then decoded: decoding takes milliseconds
    and would come between the two exposures. Each image's stamp is the clock right after its grab.

    Parameters
    ----------
    names, sizes, rate, clock
        As of `open_source`.
    open_capture : callable
        Opens a device by its name; OpenCV's by default.
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
                # An old frame from a queue would be stamped as a new one.
                (cv2.CAP_PROP_BUFFERSIZE, 1),
            ):
                capture.set(key, value)

    def next(self) -> StampedPair | None:
        """Return the next pair; None where a camera gave none."""
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
        for (side, wanted), image in zip(self._sizes.items(), (left, right), strict=True):
            if problem := size_problem(side, image.shape[::-1], wanted):
                raise UserError(problem)
        return StampedPair(left, right, stamps["left"], stamps["right"])

    def close(self) -> None:
        """Let go of the cameras."""
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

    Both images of a pair carry one stamp: the clock when the pair is asked for.

    Parameters
    ----------
    names, sizes, clock, loop
        As of `open_source`.
    """

    def __init__(
        self, names: tuple[str, str], sizes: Sizes, clock: Callable[[], int], *, loop: bool
    ) -> None:
        self._clock, self._sizes, self._loop = clock, sizes, loop
        self._pairs = open_pairs(Path(names[0]), Path(names[1])).refuse_unpaired()
        # A recording of another size is refused before anything is published.
        next(self._read())
        self._events = self._read()

    def next(self) -> StampedPair | EndOfRecording | None:
        """Return the next pair; None where one of its images cannot be read."""
        return next(self._events)

    def close(self) -> None:
        """Let go of the files."""
        self._events = iter(())

    def _read(self) -> Iterator[StampedPair | EndOfRecording | None]:
        goes_on = True
        while goes_on:
            goes_on = False
            for pair in self._pairs:
                stamp = self._clock()
                if pair.left is None or pair.right is None:
                    yield None
                    continue
                if problem := pair.problem(self._sizes):
                    raise UserError(f"{pair.name}: {problem}")
                goes_on = self._loop
                yield StampedPair(pair.left, pair.right, stamp, stamp)
        while True:
            yield EndOfRecording(self._pairs.missing)


def _open_device(name: str) -> cv2.VideoCapture:
    # What goes wrong is said by us, in one line; OpenCV's own lines are for its developers.
    opencv = cast(Any, cv2)
    # OpenCV 5 has moved it.
    logging = opencv if hasattr(opencv, "setLogLevel") else opencv.utils.logging
    logging.setLogLevel(0)
    if name.isdecimal():
        return cv2.VideoCapture(int(name), cv2.CAP_V4L2)
    return cv2.VideoCapture(name, cv2.CAP_V4L2)
