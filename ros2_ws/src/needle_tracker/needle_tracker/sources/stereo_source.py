"""Sources of image pairs: two cameras, two folders or two video files; and their port."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2

from needle_core.component import Batch, PortChange
from needle_core.errors import UserError
from needle_tracker.sources.image_files import (
    Image,
    PairSequence,
    Sizes,
    grey_frame,
    open_pairs,
    size_problem,
)

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


Event = StampedPair | EndOfRecording | None
"""Result of a read of a source: None for a pair that could not be read."""
Source = Generator[Event, None, None]
"""Open cameras or recording; a read raises a `UserError` for lost cameras or another size."""


def open_source(
    names: tuple[str, str], sizes: Sizes, rate: float, clock: Callable[[], int], *, loop: bool
) -> Source:
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
        recording = open_pairs(Path(left), Path(right)).refuse_unpaired()
        # Reject a recording of another size before its first pair is published.
        next(recorded_pairs(recording, sizes, clock, loop=False))
        return recorded_pairs(recording, sizes, clock, loop=loop)
    if left == right:
        raise UserError(f"left and right are the same camera, {left!r}")
    return camera_pairs(open_cameras(names, sizes, rate), sizes, clock)


def open_cameras(names: tuple[str, str], sizes: Sizes, rate: float) -> list[cv2.VideoCapture]:
    """Return the left and the right camera, opened by OpenCV; see `open_source`."""
    # Failures are reported in one line; silence the messages of OpenCV, of which 5 moved this.
    logging = cv2 if hasattr(cv2, "setLogLevel") else cv2.utils.logging
    logging.setLogLevel(0)
    captures: list[cv2.VideoCapture] = []
    for (side, (width, height)), name in zip(sizes.items(), names, strict=True):
        if name.startswith("/dev/") and not Path(name).exists():
            raise UserError(f"{side} camera {name} does not exist")
        capture = cv2.VideoCapture(int(name) if name.isdecimal() else name, cv2.CAP_V4L2)
        captures.append(capture)
        if not capture.isOpened():
            for opened in captures:
                opened.release()
            raise UserError(f"{side} camera {name} cannot be opened: missing, or in use")
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
        capture.set(cv2.CAP_PROP_FPS, rate)
        # An old frame from a queue would get a new stamp.
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    return captures


def camera_pairs(
    captures: list[cv2.VideoCapture], sizes: Sizes, clock: Callable[[], int]
) -> Source:
    """Yield pairs of two cameras, and close them at the end.

    Both images are grabbed before the first is decoded: decoding takes milliseconds, which would
    separate the two exposures. The stamp of an image is the time right after its grab.

    Parameters
    ----------
    captures : list of VideoCapture
        The left and the right camera.
    sizes, clock
        As for `open_source`.
    """
    failed = 0
    try:
        while failed < LOST_AFTER:
            grabs = [(capture.grab(), clock()) for capture in captures]
            is_whole = all(is_grabbed for is_grabbed, _ in grabs)
            left, right = (grey_frame(*c.retrieve()) if is_whole else None for c in captures)
            if left is None or right is None:
                failed += 1
                if failed < LOST_AFTER:
                    yield None
                continue
            failed = 0
            for (side, expected), image in zip(sizes.items(), (left, right), strict=True):
                if problem := size_problem(side, image.shape[::-1], expected):
                    raise UserError(problem)
            yield StampedPair(left, right, grabs[0][1], grabs[1][1])
        raise UserError(f"the cameras gave no pair {LOST_AFTER} times in a row: unplugged?")
    finally:
        for capture in captures:
            capture.release()


def recorded_pairs(
    pairs: PairSequence, sizes: Sizes, clock: Callable[[], int], *, loop: bool
) -> Source:
    """Yield the pairs of a recording, then its end.

    Both images of a pair have one stamp: the time of the request.

    Parameters
    ----------
    pairs : PairSequence
        Two folders or two videos.
    sizes, clock, loop
        As for `open_source`.
    """
    repeat = True
    while repeat:
        repeat = False
        for pair in pairs:
            stamp = clock()
            if pair.left is None or pair.right is None:
                yield None
                continue
            if problem := pair.problem(sizes):
                raise UserError(f"{pair.name}: {problem}")
            repeat = loop
            yield StampedPair(pair.left, pair.right, stamp, stamp)
    while True:
        yield EndOfRecording(pairs.missing)


class PairPort:
    """Port of a source: a thread reads the next pair on each request.

    Parameters
    ----------
    source : Source
        An open source, closed with the port.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._reader = ThreadPoolExecutor(1, "pairs")

    def open(self, arrive: Callable[[Batch | PortChange], None]) -> None:
        """Set the callback that the thread calls with results."""
        self._arrive = arrive

    def send(self, batch: tuple[Any, ...]) -> None:
        """Request the next pair."""
        self._reader.submit(next, self._source).add_done_callback(self._on_read)

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
