"""ChArUco board: detection of its corners in an image, and a file to print."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from needle_core.errors import UserError
from needle_core.settings.bounds import check_bounds

Array = NDArray[np.float64]

_INCH = 0.0254
_PRINT_DPI = 600
_SQUARE_PX = 240  # of the drawing that is printed, in whole pixels
_MARGIN = 0.01  # [m] of white paper on all sides


@dataclasses.dataclass(frozen=True)
class CharucoBoard:
    """A chessboard with ArUco markers in its white squares.

    The frame of the board has its origin at the outer corner of the first square (top left as
    printed, beside the first marker), x along the columns (to the right), y along the rows (down),
    z into the paper [m].

    Attributes
    ----------
    columns, rows : int
        Number of squares along x and y.
    square, marker : float
        Side of a square and of a marker, as measured on the printed board [m].
    dictionary : str
        Name of the marker dictionary in OpenCV.
    legacy : bool
        Whether OpenCV before 4.6 printed it: with an even number of rows, the first square is then
        white.

    Raises
    ------
    UserError
        An impossible board.
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
            raise UserError(f"board.dictionary = {self.dictionary!r} is not one of OpenCV's")
        wanted = self.columns * self.rows // 2
        markers = len(cv2.aruco.getPredefinedDictionary(number).bytesList)
        if markers < wanted:
            raise UserError(
                f"board of {self.columns} x {self.rows} squares needs {wanted} markers, "
                f"{self.dictionary} has {markers}"
            )

    def __str__(self) -> str:
        """Return a description."""
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
        """Inner corners in the frame of the board [m], shape ((columns-1)*(rows-1), 3)."""
        v, u = np.mgrid[1 : self.rows, 1 : self.columns]
        flat = np.stack([u.ravel(), v.ravel(), np.zeros(u.size)], axis=-1)
        return np.asarray(self.square * flat)

    def find(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.intp], Array]:
        """Find the inner corners of the board in an image.

        Parameters
        ----------
        image : ndarray of uint8, shape (height, width)
            Grey image.

        Returns
        -------
        numbers : ndarray of int, shape (n,)
            Indices of the found `corners`, ascending.
        pixels : ndarray, shape (n, 2)
            Positions, pixel centres at integers.
        """
        parameters = cv2.aruco.CharucoParameters()
        detector = cv2.aruco.CharucoDetector(self._opencv(), parameters)
        pixels, numbers, _, _ = detector.detectBoard(image)
        if pixels is None or numbers is None or len(numbers) == 0:
            return np.zeros(0, dtype=np.intp), np.zeros((0, 2))
        # OpenCV 5 drops the axis of length 1 that 4 has.
        flat = np.asarray(pixels, dtype=np.float32).reshape(-1, 2)
        # The window must exclude the markers, which bias the corner.
        gap = 0.5 * (1.0 - self.marker / self.square) * min(pdist(flat), default=20.0)
        half = max(2, int(0.9 * gap))
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
        refined = cv2.cornerSubPix(
            image, flat.reshape(-1, 1, 2).copy(), (min(half, 11),) * 2, (-1, -1), criteria
        )
        order = np.argsort(np.asarray(numbers).reshape(-1))
        found = np.asarray(refined, dtype=np.float64).reshape(-1, 2)
        return np.asarray(numbers, dtype=np.intp).reshape(-1)[order], found[order]

    def drawing(self, square_px: int) -> NDArray[np.uint8]:
        """Return the pattern without margin, each square of so many pixels."""
        size = self.columns * square_px, self.rows * square_px
        return np.asarray(self._opencv().generateImage(size), dtype=np.uint8)

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
        The board.
    path : Path
        `.pdf` or `.png` (600 dpi, with its size).

    Raises
    ------
    UserError
        Another ending, or a file that cannot be written.
    """
    if path.suffix.lower() not in (".pdf", ".png"):
        raise UserError(f"--board {path}: must end in .pdf or .png")
    length, height = board.size
    paper = (length + 2 * _MARGIN, height + 2 * _MARGIN)
    figure = Figure(figsize=(paper[0] / _INCH, paper[1] / _INCH))
    axes = figure.add_axes(
        (_MARGIN / paper[0], _MARGIN / paper[1], length / paper[0], height / paper[1])
    )
    axes.axis("off")
    # A PDF embeds the drawing at its exact size; a PNG would round its edges to whole dots.
    axes.imshow(
        board.drawing(_SQUARE_PX),
        cmap="gray",
        extent=(0.0, length, height, 0.0),
        interpolation="none" if path.suffix.lower() == ".pdf" else "bilinear",
        aspect="auto",
    )
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
