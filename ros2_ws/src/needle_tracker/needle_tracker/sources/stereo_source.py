"""Sources of image pairs: two cameras, two folders or two video files."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol, cast

import cv2
import numpy as np

from needle_core.errors import UserError
from needle_tracker.sources.image_files import Image, NamedPair, PairSequence, open_pairs

Sizes = dict[str, tuple[int, int]]
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


@dataclasses.dataclass(frozen=True)
class SourceSettings:
    """Settings of a source.

    Attributes
    ----------
    left, right : str
        Device number or `/dev/...`, folder, or video file.
    sizes : dict of str to (int, int)
        Width and height that each side's images must have [px].
    rate : float
        Pairs a second that cameras are asked for.
    loop : bool
        Whether a recording begins again at its end.
    """

    left: str
    right: str
    sizes: Sizes
    rate: float
    loop: bool


def open_source(settings: SourceSettings, clock: Callable[[], int]) -> StereoSource:
    """Open cameras or a recording.

    Parameters
    ----------
    settings : SourceSettings
        What to open.
    clock : callable
        Returns the time [ns] that images are stamped with.

    Raises
    ------
    UserError
        Something is missing, cannot be opened, or is not of the calibration's size.
    """
    given = {"left": settings.left, "right": settings.right}
    for side, name in given.items():
        if not name:
            raise UserError(f"{side} is empty: a device number, /dev/videoN, a folder or a video")
    # A camera is a number, or below /dev/.
    are_cameras = [name.isdecimal() or name.startswith("/dev/") for name in given.values()]
    if are_cameras[0] != are_cameras[1]:
        raise UserError(
            f"left = {settings.left!r} and right = {settings.right!r}: one is a camera, the other "
            "a recording"
        )
    if are_cameras[0]:
        if settings.left == settings.right:
            raise UserError(f"left and right are the same camera, {settings.left!r}")
        return CameraPair(settings, clock)
    return RecordedPairs(settings, clock)


class CameraPair:
    """Two cameras through OpenCV.

    Both are grabbed, one right after the other, and only then decoded: decoding takes milliseconds
    and would come between the two exposures. Each image's stamp is the clock right after its grab.

    Parameters
    ----------
    settings : SourceSettings
        What to open.
    clock : callable
        Returns the time [ns].
    open_capture : callable
        Opens a device by its name; OpenCV's by default.
    """

    def __init__(
        self,
        settings: SourceSettings,
        clock: Callable[[], int],
        open_capture: Callable[[str], cv2.VideoCapture] | None = None,
    ) -> None:
        self._clock = clock
        self._sizes = settings.sizes
        self._failed = 0
        self._captures: dict[str, cv2.VideoCapture] = {}
        opened = open_capture or _open_device
        for side, name in (("left", settings.left), ("right", settings.right)):
            if name.startswith("/dev/") and not Path(name).exists():
                raise UserError(f"{side} camera {name} does not exist")
            capture = opened(name)
            if not capture.isOpened():
                self.close()
                raise UserError(f"{side} camera {name} cannot be opened: missing, or in use")
            self._captures[side] = capture
            width, height = settings.sizes[side]
            for key, value in (
                (cv2.CAP_PROP_FRAME_WIDTH, width),
                (cv2.CAP_PROP_FRAME_HEIGHT, height),
                (cv2.CAP_PROP_FPS, settings.rate),
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
        left, right = (self._retrieve(side) if grabbed else None for side in ("left", "right"))
        if left is None or right is None:
            self._failed += 1
            if self._failed >= LOST_AFTER:
                raise UserError(f"the cameras gave no pair {LOST_AFTER} times in a row: unplugged?")
            return None
        self._failed = 0
        check_size("left", left, self._sizes)
        check_size("right", right, self._sizes)
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
    settings : SourceSettings
        What to open.
    clock : callable
        Returns the time [ns].
    """

    def __init__(self, settings: SourceSettings, clock: Callable[[], int]) -> None:
        self._clock = clock
        self._settings = settings
        self._pairs: PairSequence = open_pairs(Path(settings.left), Path(settings.right))
        if self._pairs.unpaired:
            raise UserError(
                f"images without a partner ({len(self._pairs.unpaired)}): {self._pairs.unpaired[0]}"
            )
        self._any = False
        self._next: Iterator[NamedPair] = iter(self._pairs)
        # A recording of another size is refused before anything is published.
        for pair in self._pairs:
            _check_sizes(pair, settings.sizes)
            break

    def next(self) -> StampedPair | EndOfRecording | None:
        """Return the next pair; None where one of its images cannot be read."""
        pair = next(self._next, None)
        if pair is None and self._settings.loop and self._any:
            self._next = iter(self._pairs)
            pair = next(self._next, None)
        if pair is None:
            return EndOfRecording(self._pairs.missing)
        stamp = self._clock()
        if pair.left is None or pair.right is None:
            return None
        _check_sizes(pair, self._settings.sizes)
        self._any = True
        return StampedPair(pair.left, pair.right, stamp, stamp)

    def close(self) -> None:
        """Let go of the files."""
        self._next = iter(())


def check_size(side: str, image: Image, sizes: Sizes, name: str = "") -> None:
    """Refuse an image that is not of the calibration's size.

    Raises
    ------
    UserError
        With both sizes.
    """
    size, wanted = (image.shape[1], image.shape[0]), sizes[side]
    if size != wanted:
        raise UserError(
            f"{side} image {name + ' ' if name else ''}is {size[0]}x{size[1]}, the calibration is "
            f"for {wanted[0]}x{wanted[1]}"
        )


class RateMeter:
    """Pairs a second over the last seconds."""

    def __init__(self, window: float = 5.0) -> None:
        self._window = window
        self._times: list[float] = []

    def tick(self, now: float) -> None:
        """Note a pair."""
        self._times = [t for t in self._times if now - t <= self._window]
        self._times.append(now)

    def rate(self, now: float) -> float:
        """Return pairs a second; 0 before the second pair."""
        recent = [t for t in self._times if now - t <= self._window]
        span = recent[-1] - recent[0] if len(recent) > 1 else 0.0
        return (len(recent) - 1) / span if span > 0.0 else 0.0


def _check_sizes(pair: NamedPair, sizes: Sizes) -> None:
    for side, image in (("left", pair.left), ("right", pair.right)):
        if image is not None:
            check_size(side, image, sizes, pair.name)


def _open_device(name: str) -> cv2.VideoCapture:
    # What goes wrong is said by us, in one line; OpenCV's own lines are for its developers.
    opencv = cast(Any, cv2)
    # OpenCV 5 has moved it.
    logging = opencv if hasattr(opencv, "setLogLevel") else opencv.utils.logging
    logging.setLogLevel(0)
    if name.isdecimal():
        return cv2.VideoCapture(int(name), cv2.CAP_V4L2)
    return cv2.VideoCapture(name, cv2.CAP_V4L2)
