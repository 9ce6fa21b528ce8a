"""The ChArUco board: its corners in an image, the board to print, and the board images show."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from needle_core.errors import UserError
from needle_core.settings.bounds import check_bounds
from needle_tracker.sources.image_files import Image

Array = NDArray[np.float64]

_INCH = 0.0254
_PRINT_DPI = 600
_MARGIN = 0.01  # [m] of white paper on all sides
_IMAGES = 4  # so many are searched, in some 2 s each: there are 22 dictionaries
_LEAST_MARKERS = 8  # fewer fit any number of columns
_LARGEST_MISS = 0.2  # of a square: lens distortion stays below, another layout does not


@dataclasses.dataclass(frozen=True)
class CharucoBoard:
    """A chessboard with ArUco markers in its white squares.

    The board's frame: origin at the outer corner of the pattern's first square (top left as
    printed, the first marker beside it), x along the columns (to the right), y along the rows
    (down), z into the paper [m].

    Attributes
    ----------
    columns, rows : int
        Number of squares along x and y.
    square, marker : float
        Side of a square and of a marker, as measured on the printed board [m].
    dictionary : str
        OpenCV's name of the marker dictionary.
    legacy : bool
        Whether it was printed by OpenCV before 4.6: with an even number of rows, its first square
        then is white.

    Raises
    ------
    UserError
        A board that cannot be.
    """

    columns: int = 12
    rows: int = 9
    square: float = 0.010
    marker: float = 0.0075
    dictionary: str = "DICT_5X5_100"
    legacy: bool = False

    def __post_init__(self) -> None:
        """Check the fields."""
        for name, count in (("columns", self.columns), ("rows", self.rows)):
            check_bounds(f"board.{name}", count, 3, 100, "squares")
        check_bounds("board.square", self.square, 0.5e-3, 0.5, "m")
        check_bounds("board.marker", self.marker, 0.3 * self.square, 0.95 * self.square, "m")
        number = getattr(cv2.aruco, self.dictionary, None)
        if not self.dictionary.startswith("DICT_") or not isinstance(number, int):
            raise UserError(f"board.dictionary = {self.dictionary!r} is none of OpenCV's")
        wanted = self.columns * self.rows // 2
        markers = len(cv2.aruco.getPredefinedDictionary(number).bytesList)
        if markers < wanted:
            raise UserError(
                f"board of {self.columns} x {self.rows} squares wants {wanted} markers, "
                f"{self.dictionary} has {markers}"
            )

    def __str__(self) -> str:
        """Return what it is, for a person."""
        return (
            f"{self.columns} x {self.rows} squares of {1e3 * self.square:g} mm, markers "
            f"{1e3 * self.marker:g} mm, {self.dictionary}{', legacy' if self.legacy else ''}"
        )

    @property
    def size(self) -> tuple[float, float]:
        """Length along x and y [m]."""
        return self.columns * self.square, self.rows * self.square

    @property
    def corners(self) -> Array:
        """Inner corners in the board's frame [m], shape ((columns-1)*(rows-1), 3), by number."""
        v, u = np.mgrid[1 : self.rows, 1 : self.columns]
        flat = np.stack([u.ravel(), v.ravel(), np.zeros(u.size)], axis=-1)
        return np.asarray(self.square * flat)

    def black_squares(self) -> Array:
        """Return what is printed black: squares and modules of markers.

        Returns
        -------
        ndarray, shape (n, 3)
            x and y of the corner nearest to the origin, and the side, in the board's frame [m].
        """
        white_first = self.legacy and self.rows % 2 == 0
        parity = np.add.outer(range(self.rows), range(self.columns)) % 2
        rows, columns = np.nonzero(parity == white_first)
        sides = np.full(len(rows), self.square)
        parts = [np.column_stack([self.square * columns, self.square * rows, sides])]
        board = self._opencv()
        dictionary = board.getDictionary()
        modules = dictionary.markerSize + 2
        side = self.marker / modules
        for number, outline in zip(
            np.asarray(board.getIds()).ravel().tolist(), board.getObjPoints(), strict=True
        ):
            origin = np.asarray(outline, dtype=np.float64).reshape(-1, 3)[0, :2]
            bits = cv2.aruco.generateImageMarker(dictionary, number, modules)
            rows, columns = np.nonzero(np.asarray(bits) == 0)
            places = origin + side * np.column_stack([columns, rows])
            parts.append(np.column_stack([places, np.full(len(rows), side)]))
        return np.concatenate(parts)

    def find(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.intp], Array]:
        """Find the board's inner corners in an image.

        Parameters
        ----------
        image : ndarray of uint8, shape (height, width)
            Grey image.

        Returns
        -------
        numbers : ndarray of int, shape (n,)
            Which of `corners` were found, ascending.
        pixels : ndarray, shape (n, 2)
            Where, pixel centres at integers.
        """
        parameters = cv2.aruco.CharucoParameters()
        detector = cv2.aruco.CharucoDetector(self._opencv(), parameters)
        pixels, numbers, _, _ = detector.detectBoard(image)
        if pixels is None or numbers is None or len(numbers) == 0:
            return np.zeros(0, dtype=np.intp), np.zeros((0, 2))
        # OpenCV 5 drops the axis of length 1 that 4 has.
        flat = np.asarray(pixels, dtype=np.float32).reshape(-1, 2)
        # The window must not reach the markers, which pull the corner.
        gap = 0.5 * (1.0 - self.marker / self.square) * min(pdist(flat), default=20.0)
        half = max(2, int(0.9 * gap))
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
        refined = cv2.cornerSubPix(
            image, flat.reshape(-1, 1, 2).copy(), (min(half, 11),) * 2, (-1, -1), criteria
        )
        order = np.argsort(np.asarray(numbers).reshape(-1))
        found = np.asarray(refined, dtype=np.float64).reshape(-1, 2)
        return np.asarray(numbers, dtype=np.intp).reshape(-1)[order], found[order]

    def _opencv(self) -> cv2.aruco.CharucoBoard:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square, self.marker, dictionary
        )
        board.setLegacyPattern(self.legacy)
        return board


def write_board(board: CharucoBoard, path: Path) -> None:
    """Write the board at its true size, to print at 100 %.

    Parameters
    ----------
    board : CharucoBoard
        What to draw.
    path : Path
        `.pdf` or `.png` (600 dpi, the size in the file).

    Raises
    ------
    UserError
        Another ending, or a file that cannot be written.
    """
    if path.suffix.lower() not in (".pdf", ".png"):
        raise UserError(f"--board {path}: ends neither in .pdf nor in .png")
    length, height = board.size
    paper = (length + 2 * _MARGIN, height + 2 * _MARGIN)
    figure = Figure(figsize=(paper[0] / _INCH, paper[1] / _INCH))
    axes = figure.add_axes(
        (_MARGIN / paper[0], _MARGIN / paper[1], length / paper[0], height / paper[1])
    )
    axes.set(xlim=(0.0, length), ylim=(height, 0.0))
    axes.axis("off")
    # Drawn, not an image: that would be fitted to whole dots, and all of the board be larger.
    black = [Rectangle((x, y), side, side) for x, y, side in board.black_squares()]
    axes.add_collection(PatchCollection(black, facecolor="black", linewidth=0.0, snap=False))
    figure.text(
        0.5,
        0.25 * _MARGIN / paper[1],
        f"{board}; origin: top left corner of the pattern",
        ha="center",
        fontsize=6,
    )
    try:
        figure.savefig(path, dpi=_PRINT_DPI)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error


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
    found = "its markers identify no other board either"
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
