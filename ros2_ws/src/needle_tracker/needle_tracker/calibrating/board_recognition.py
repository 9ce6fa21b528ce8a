"""Which ChArUco board images show, by its markers alone, where it is not the one looked for."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_common.errors import UserError
from needle_tracker.calibrating.charuco import CharucoBoard
from needle_tracker.sources.image_files import Image

_IMAGES = 4  # so many are searched, in some 2 s each: there are 22 dictionaries
_LEAST_MARKERS = 8  # fewer fit any number of columns
_LARGEST_MISS = 0.2  # of a square: lens distortion stays below, another layout does not


def check_board_seen(images: Iterable[Image], board: CharucoBoard) -> None:
    """Refuse images in which the board was not found, and name the board that they show.

    Parameters
    ----------
    images : iterable of ndarray of uint8, shape (height, width)
        Grey images.
    board : CharucoBoard
        What was looked for.

    Raises
    ------
    UserError
        Always.
    """
    shown = _shown_board(list(itertools.islice(images, _IMAGES)), board)
    found = "nor one that its markers tell"
    if shown is not None:
        wanted = dataclasses.asdict(board).items()
        changes = [
            f"{k}: {v}" for k, v in dataclasses.asdict(shown).items() if (k, v) not in wanted
        ]
        found = "its markers are there, but no corner between them (blurred, or too small?)"
        if changes:
            found = (
                f"the markers are those of another one, give `{', '.join(changes)}` as its board"
            )
    raise UserError(f"no image shows the session's board ({board}): {found}")


def _shown_board(images: list[Image], board: CharucoBoard) -> CharucoBoard | None:
    dictionary = _dictionary(images, board)
    if dictionary is None:
        return None
    seen = [_markers(image, dictionary) for image in images]
    ids, centres = max(seen, key=lambda markers: len(markers[0]))
    highest = max(int(ids.max(initial=0)) for ids, _ in seen)
    misses = {}
    for columns, legacy in itertools.product(range(3, 41), (False, True)):
        grid = itertools.product(range(2 * highest // columns + 4), range(columns))
        places = np.array([(x, y) for y, x in grid if (x + y) % 2 != legacy], dtype=np.float64)[ids]
        homography, _ = cv2.findHomography(centres, places)
        if homography is not None:
            mapped = cv2.perspectiveTransform(centres[:, None], homography)[:, 0]
            misses[columns, legacy] = float(np.abs(mapped - places).max())
    columns, legacy = min(misses, key=lambda layout: misses[layout])
    if misses[columns, legacy] > _LARGEST_MISS:
        return None
    # Each marker needs a square; the legacy layout differs where the number of rows is even.
    rows = max(3, -(-2 * (highest + 1) // columns))
    rows += legacy and rows % 2
    if columns == board.columns and rows < board.rows and not (legacy and board.rows % 2):
        rows = board.rows
    return CharucoBoard(columns, rows, board.square, board.marker, dictionary, legacy)


def _dictionary(images: list[Image], board: CharucoBoard) -> str | None:
    """Return which dictionary the markers are of, the board's own if it may be that."""
    names = {getattr(cv2.aruco, name): name for name in dir(cv2.aruco) if name.startswith("DICT_")}
    # A small one is the beginning of larger ones: it is preferred where it finds as many.
    by_size = sorted(names.values(), key=lambda name: len(_known(name).bytesList))
    for candidates in ([board.dictionary], by_size):
        for image in images:
            counts = [len(_markers(image, name)[0]) for name in candidates]
            if max(counts) >= _LEAST_MARKERS:
                return candidates[int(np.argmax(counts))]
    return None


def _known(dictionary: str) -> Any:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))


def _markers(image: Image, dictionary: str) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return the numbers of the markers in an image, and their middles [px]."""
    corners, ids, _ = cv2.aruco.ArucoDetector(_known(dictionary)).detectMarkers(image)
    middles = np.reshape(corners, (-1, 4, 2)).mean(axis=1, dtype=np.float64)
    return np.ravel([] if ids is None else ids).astype(np.intp), middles
