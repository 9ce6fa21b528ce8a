"""Image files paired by name, or two videos frame by frame, as one sequence of named pairs."""

from __future__ import annotations

import csv
import dataclasses
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_common.errors import UserError

Image = NDArray[np.uint8]

_SUFFIXES = frozenset(
    (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".pnm", ".ppm", ".tif", ".tiff", ".webp", ".jp2")
)


@dataclasses.dataclass(frozen=True)
class NamedPair:
    """The images of one name; None for one that cannot be read.

    Attributes
    ----------
    name : str
        File name; for videos the frame's number, from 000000 on.
    left, right : ndarray of uint8, shape (height, width), or None
        Grey images.
    """

    name: str
    left: Image | None
    right: Image | None


@dataclasses.dataclass
class PairSequence:
    """Pairs in the order of their names, read one by one.

    Attributes
    ----------
    names : list of str
        Of the pairs, in order (numbers in a name count as numbers). Of videos: as many as the
        containers promise.
    unpaired : list of str
        Names, with their side, that have no partner; of videos known at the end.
    cut_off : int
        Pairs that the videos' containers promised and their data did not give; known at the end.
    """

    names: list[str]
    unpaired: list[str]
    _left: Path
    _right: Path
    _videos: bool
    cut_off: int = 0

    @property
    def missing(self) -> str:
        """Frames that the videos lacked, in words, known at the end; empty where all is there."""
        parts = []
        if self.unpaired:
            parts.append(f"{len(self.unpaired)} frames without a partner")
        if self.cut_off:
            parts.append(f"{self.cut_off} of {len(self.names)} pairs cannot be read: cut off?")
        return ", ".join(parts)

    def __iter__(self) -> Iterator[NamedPair]:
        """Read pair after pair."""
        return self._frames() if self._videos else self._files()

    def _files(self) -> Iterator[NamedPair]:
        for name in self.names:
            yield NamedPair(name, _read(self._left / name), _read(self._right / name))

    def _frames(self) -> Iterator[NamedPair]:
        left, right = (cv2.VideoCapture(str(path)) for path in (self._left, self._right))
        try:
            number = 0
            self.unpaired.clear()
            while True:
                frames = [_next_frame(video) for video in (left, right)]
                if frames[0] is None or frames[1] is None:
                    break
                yield NamedPair(f"{number:06d}", frames[0], frames[1])
                number += 1
            for side, video, more in (("left", left, frames[0]), ("right", right, frames[1])):
                rest, unpaired = more, number
                while rest is not None:
                    self.unpaired.append(f"{side} {unpaired:06d}")
                    unpaired += 1
                    rest = _next_frame(video)
            self.cut_off = max(len(self.names) - number, 0)
        finally:
            left.release()
            right.release()


def open_pairs(left: Path, right: Path) -> PairSequence:
    """Open two folders of images or two videos.

    Parameters
    ----------
    left, right : Path
        Both folders, or both video files.

    Returns
    -------
    PairSequence
        Not empty.

    Raises
    ------
    UserError
        One is missing or cannot be opened, only one is a folder, or nothing pairs.
    """
    for side, path in (("left", left), ("right", right)):
        if not path.exists():
            raise UserError(f"--{side} {path}: does not exist")
    if left.is_dir() != right.is_dir():
        raise UserError(f"--left {left} and --right {right}: one is a folder, the other is not")
    if not left.is_dir():
        counts = [_frame_count(side, path) for side, path in (("left", left), ("right", right))]
        names = [f"{number:06d}" for number in range(max(min(counts), 0))]
        return PairSequence(names, [], left, right, True)
    found = [_images_in(side, path) for side, path in (("left", left), ("right", right))]
    names = sorted(found[0] & found[1], key=_natural)
    unpaired = [f"left {name}" for name in sorted(found[0] - found[1], key=_natural)]
    unpaired += [f"right {name}" for name in sorted(found[1] - found[0], key=_natural)]
    if not names:
        raise UserError(
            f"no image of --left {left} ({len(found[0])}, such as {min(found[0], key=_natural)}) "
            f"has one of the same name in --right {right} ({len(found[1])}, such as "
            f"{min(found[1], key=_natural)})"
        )
    return PairSequence(names, unpaired, left, right, False)


def read_insertions(path: Path) -> Mapping[str, float]:
    """Read a CSV of insertions by name, with the columns `name` and `insertion_m`.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    mapping
        Name to insertion [m]; names without a value are left out.

    Raises
    ------
    UserError
        Unreadable, a column missing, a value that is not a finite number, or a name given twice;
        the message says in which line.
    """
    insertions: dict[str, float] = {}
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.DictReader(file, skipinitialspace=True)
            columns = rows.fieldnames or []
            for column in ("name", "insertion_m"):
                if column not in columns:
                    raise UserError(f"--insertion {path}: no column {column!r} in its first line")
            for row in rows:
                name, text = (row["name"] or "").strip(), (row["insertion_m"] or "").strip()
                if not text:
                    continue
                where = f"--insertion {path}, line {rows.line_num}"
                if name in insertions:
                    raise UserError(f"{where}: {name!r} has an insertion already")
                insertions[name] = finite_field(text, where, "insertion_m")
    except OSError as error:
        raise UserError(f"--insertion {path}: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"--insertion {path} is not a CSV file: {error}") from error
    return insertions


def finite_field(text: str, where: str, column: str) -> float:
    """Return a field's number; raises UserError that says where if it is not a finite one."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UserError(f"{where}: {column} = {text!r} is not a finite number")
    return value


def _images_in(side: str, folder: Path) -> set[str]:
    try:
        names = {
            path.name
            for path in folder.iterdir()
            if path.suffix.lower() in _SUFFIXES and path.is_file()
        }
    except OSError as error:
        raise UserError(f"--{side} {folder}: {error.strerror}") from error
    if not names:
        raise UserError(f"--{side} {folder}: no images in it ({', '.join(sorted(_SUFFIXES))})")
    return names


def _natural(name: str) -> tuple[list[tuple[int, str]], str]:
    """Return a key by which frame_9 comes before frame_10."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts], name


def _read(path: Path) -> Image | None:
    """Return a file's grey image, None where it is not one of 8 bit."""
    try:
        data = np.fromfile(path, np.uint8)
    except OSError:
        return None
    if not data.size:
        return None
    # Without ANYDEPTH OpenCV would quietly make 8 bit of 16.
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        return _grey(cv2.imdecode(data, flags))
    except cv2.error:
        return None


def _frame_count(side: str, path: Path) -> int:
    video = cv2.VideoCapture(str(path))
    try:
        if not video.isOpened():
            raise UserError(f"--{side} {path}: neither a folder nor a video that can be read")
        return int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    finally:
        video.release()


def _next_frame(video: cv2.VideoCapture) -> Image | None:
    good, frame = video.read()
    if not good or frame is None:
        return None
    return _grey(frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY))


def _grey(image: NDArray[np.uint8] | None) -> Image | None:
    if image is None or image.dtype != np.uint8:
        return None
    return image if image.ndim == 2 else image.reshape(image.shape[:2])
