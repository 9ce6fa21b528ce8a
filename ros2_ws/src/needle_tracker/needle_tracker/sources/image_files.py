"""Sequences of named pairs from files: images paired by name, or two videos frame by frame."""

from __future__ import annotations

import dataclasses
import itertools
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from needle_core.errors import UserError

Image = NDArray[np.uint8]
Sizes = dict[str, tuple[int, int]]
"""Width and height of the images of each side [px]."""

_SUFFIXES = frozenset(
    (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".pnm", ".ppm", ".tif", ".tiff", ".webp", ".jp2")
)
# Differences between the names of a left and a right file: a pattern, and its replacement.
_CAMERA_NUMBER = "(?:(?<=cam)|(?<=cam[-_])|(?<=camera)|(?<=camera[-_]))%d(?!\\d)"
_WORDS = (("left", "right"), (_CAMERA_NUMBER % 0, "1"), (_CAMERA_NUMBER % 1, "2"), ("l", "r"))
_SEPARATORS = "-_. "
_SIDES = ("left", "right")
_LISTED = 5


@dataclasses.dataclass(frozen=True)
class NamedPair:
    """The two images of one name; None for an unreadable image.

    Attributes
    ----------
    name : str
        File name, without `left` or `right` if the files differ by that; for videos the number of
        the frame, from 000000 on.
    left, right : ndarray of uint8, shape (height, width), or None
        Grey images.
    files : pair of Path
        The left and the right file.
    """

    name: str
    left: Image | None
    right: Image | None
    files: tuple[Path, Path]

    @property
    def names(self) -> tuple[str, ...]:
        """Names that a session or a CSV may use for the pair, with and without suffix."""
        paths = (Path(self.name), *self.files)
        return tuple(dict.fromkeys(name for path in paths for name in (path.name, path.stem)))

    def number_in(self, numbers: Mapping[str, float]) -> float | None:
        """Return the number under one of its names, if any."""
        return next((numbers[name] for name in self.names if name in numbers), None)

    def problem(self, sizes: Sizes) -> str:
        """Return the problem with an image, such as another size; empty if both are usable."""
        for (side, expected), image in zip(sizes.items(), (self.left, self.right), strict=True):
            if image is None:
                return f"{side} image is unreadable or not of 8 bit"
            if problem := size_problem(side, image.shape[::-1], expected):
                return problem
        return ""


def size_problem(side: str, size: tuple[int, ...], expected: tuple[int, int]) -> str:
    """Return a message if the size of an image differs from the calibration, else an empty text.

    Sizes are width and height [px].
    """
    if size == expected:
        return ""
    return (
        f"{side} image is {size[0]}x{size[1]}, the calibration is for {expected[0]}x{expected[1]}"
    )


@dataclasses.dataclass
class PairSequence:
    """Pairs in the order of their names, read on demand.

    Attributes
    ----------
    names : list of str
        Names of the pairs, in natural order; for videos as many as the containers declare.
    unpaired : list of str
        Names without a partner, with their side; for videos, complete only at the end.
    """

    names: list[str]
    unpaired: list[str]
    _left: Path
    _right: Path
    _files: list[tuple[str, str]] | None
    _cut_off: int = 0  # pairs that the containers declare but the data lack

    def refuse_unpaired(self) -> PairSequence:
        """Return the sequence itself; raises a `UserError` if an image has no partner."""
        if self.unpaired:
            raise UserError(self.missing)
        return self

    @property
    def missing(self) -> str:
        """Missing images as text; for videos, complete only at the end; empty if complete."""
        parts = []
        if self.unpaired:
            parts.append(f"{len(self.unpaired)} images without a partner: {listed(self.unpaired)}")
        if self._cut_off:
            parts.append(f"{self._cut_off} of {len(self.names)} pairs cannot be read: cut off?")
        return ", ".join(parts)

    def __iter__(self) -> Iterator[NamedPair]:
        """Yield the pairs in order."""
        return self._frames() if self._files is None else self._images(self._files)

    def _images(self, files: list[tuple[str, str]]) -> Iterator[NamedPair]:
        for name, (left, right) in zip(self.names, files, strict=True):
            paths = self._left / left, self._right / right
            yield NamedPair(name, _read(paths[0]), _read(paths[1]), paths)

    def _frames(self) -> Iterator[NamedPair]:
        videos = [cv2.VideoCapture(str(path)) for path in (self._left, self._right)]
        self.unpaired.clear()
        for index in itertools.count():
            left, right = frames = [grey_frame(*video.read()) for video in videos]
            if left is None or right is None:
                break
            name = f"{index:06d}"
            yield NamedPair(name, left, right, (self._left / name, self._right / name))
        for side, video, more in zip(_SIDES, videos, frames, strict=True):
            unpaired, frame = index, more
            while frame is not None:
                self.unpaired.append(f"{side} {unpaired:06d}")
                unpaired, frame = unpaired + 1, grey_frame(*video.read())
        self._cut_off = max(len(self.names) - index, 0)


def open_pairs(left: Path, right: Path) -> PairSequence:
    """Open two folders of images or two videos.

    Parameters
    ----------
    left, right : Path
        Both folders, or both video files.

    Returns
    -------
    PairSequence
        Sequence of at least one pair.

    Raises
    ------
    UserError
        A path is missing or cannot be opened, only one is a folder, or no images form a pair.
    """
    paths = dict(zip(_SIDES, (left, right), strict=True))
    for side, path in paths.items():
        if not path.exists():
            raise UserError(f"--{side} {path}: does not exist")
    if left.is_dir() != right.is_dir():
        raise UserError(f"--left {left} and --right {right}: one is a folder, the other is not")
    if not left.is_dir():
        count = min(_frame_count(side, path) for side, path in paths.items())
        names = [f"{index:06d}" for index in range(count)]
        return PairSequence(names, [], left, right, None)
    one_folder = left.samefile(right)
    found = [_images_in(side, path) for side, path in paths.items()]
    pairs = sorted(_pair(*found, one_folder=one_folder), key=lambda pair: _natural(pair[0]))
    if not pairs:
        samples = [f"{len(names)}, such as {min(names, key=_natural)}" for names in found]
        raise UserError(
            f"no image of --left {left} ({samples[0]}) has a partner in --right "
            f"{'the same folder' if one_folder else f'{right} ({samples[1]})'}: names must "
            f"{'' if one_folder else 'be the same or '}differ in left and right, l and r, or cam0 "
            "and cam1"
        )
    files = [(left_name, right_name) for _, left_name, right_name in pairs]
    # Files of the same name in two folders are a pair: a name is used in both or in neither.
    used = {name for names in files for name in names}
    unpaired = [
        f"{side} {name}"
        for side, names in zip(_SIDES, found[:1] if one_folder else found, strict=False)
        for name in sorted(names - used, key=_natural)
    ]
    return PairSequence([name for name, *_ in pairs], unpaired, left, right, files)


def listed(names: Sequence[str]) -> str:
    """Return some names as text; of many, only the number of the others."""
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more


def progress(pairs: PairSequence, what: str) -> Iterator[NamedPair]:
    """Yield the pairs, with a progress bar on a terminal."""
    hidden = not sys.stderr.isatty()
    yield from tqdm(
        pairs, what, len(pairs.names), unit="pair", delay=1.0, leave=False, disable=hidden
    )


def mean_pair(left: Path, right: Path, sizes: Sizes) -> tuple[Image, Image]:
    """Return the mean of all pairs of two folders or videos, to reduce noise.

    Parameters
    ----------
    left, right : Path
        As for `open_pairs`.
    sizes : dict of str to (int, int)
        Required width and height of the images of each side [px].

    Raises
    ------
    UserError
        As `open_pairs`, and for an image that cannot be read or is of another size.
    """
    sums, count = [np.zeros(size[::-1]) for size in sizes.values()], 0
    for count, pair in enumerate(open_pairs(left, right), 1):  # noqa: B007
        if problem := pair.problem(sizes):
            raise UserError(f"{left.parent}, {pair.name}: {problem}")
        for total, image in zip(sums, (pair.left, pair.right), strict=True):
            np.add(total, np.asarray(image), out=total)
    first, second = (np.rint(total / count).astype(np.uint8) for total in sums)
    return first, second


def _pair(left: set[str], right: set[str], *, one_folder: bool) -> list[tuple[str, str, str]]:
    """Return name, left and right file of each pair, matched by equal names, else by `_WORDS`."""
    equal = set() if one_folder else left & right
    pairs = [(name, name, name) for name in equal]
    unused = right - equal
    for name in sorted(left - equal, key=_natural):
        fitting = [pair for pair in _partners(name) if pair[0] in unused - {name}]
        if fitting and not (one_folder and name not in unused):
            partner, shared = fitting[0]
            pairs.append((shared, name, partner))
            unused -= {partner, name} if one_folder else {partner}
    return pairs


def _partners(name: str) -> Iterator[tuple[str, str]]:
    """Yield possible names of the right file for a left one, and the name that both share."""
    stem, suffix = Path(name).stem, Path(name).suffix
    for left, right in _WORDS:
        for match in re.finditer(left, stem, re.IGNORECASE):
            word = match.group()
            word = right.upper() if word.isupper() else right.title() if word.istitle() else right
            around = stem[: match.start()], stem[match.end() :]
            kept = [part.strip(_SEPARATORS) for part in around]
            shared = ("_" if kept != list(around) else "").join(filter(None, kept)) or stem
            yield around[0] + word + around[1] + suffix, shared + suffix


def _images_in(side: str, folder: Path) -> set[str]:
    try:
        files = [path for path in folder.iterdir() if path.is_file()]
    except OSError as error:
        raise UserError(f"--{side} {folder}: {error.strerror}") from error
    names = {path.name for path in files if path.suffix.lower() in _SUFFIXES}
    if not names:
        raise UserError(f"--{side} {folder}: no images in it ({', '.join(sorted(_SUFFIXES))})")
    return names


def _natural(name: str) -> tuple[list[tuple[int, str]], str]:
    """Return a key that sorts frame_9 before frame_10."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts], name


def _read(path: Path) -> Image | None:
    """Return the grey image of a file; None unless it has 8 bits."""
    # Without ANYDEPTH OpenCV would silently convert 16 bits to 8.
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    return grey_frame(True, cv2.imread(str(path), flags))


def _frame_count(side: str, path: Path) -> int:
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise UserError(f"--{side} {path}: not a folder or a readable video")
    return int(video.get(cv2.CAP_PROP_FRAME_COUNT))


def grey_frame(is_read: bool, frame: NDArray[Any] | None) -> Image | None:
    """Return the grey image of a result of OpenCV; None if it is missing or not of 8 bits."""
    if not is_read or frame is None or frame.dtype != np.uint8:
        return None
    is_grey = frame.shape[2:] in ((), (1,))
    return frame.reshape(frame.shape[:2]) if is_grey else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
