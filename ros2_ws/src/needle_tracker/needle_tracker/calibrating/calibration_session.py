"""Inputs of a calibration: the board, and the places where it was laid."""

from __future__ import annotations

import dataclasses
import fnmatch
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from needle_core.errors import UserError
from needle_core.files.yaml_files import read_yaml
from needle_core.settings.bounds import check_bounds
from needle_tracker.calibrating.charuco import CharucoBoard
from needle_tracker.optics.calibration import (
    SIDES,
    number,
    numbers,
    parse_windows,
)
from needle_tracker.optics.window import Window, common_surface

Array = NDArray[np.float64]

_LEAST_SINE = math.cos(math.radians(5.0))
_PLACE_KEYS = ("origin", "columns", "rows", "under_surface", "sigma")
_SURFACE_KEYS = ("surface_height", "refractive_index")
_BOARD_KEYS = ("columns", "rows", "square", "marker", "dictionary", "legacy")


@dataclasses.dataclass(frozen=True)
class Place:
    """Place where a board lay.

    Attributes
    ----------
    T_rig_board : ndarray, shape (4, 4)
        Takes points of the board's frame to `rig` [m].
    under_surface : bool
        Whether it was in the phantom, and so seen through the windows.
    sigma : float
        Standard deviation of the place's coordinates [m]; 0: exact, it defines `rig`; infinite:
        held freely, `T_rig_board` says nothing.
    """

    T_rig_board: Array
    under_surface: bool = False
    sigma: float = 0.0

    @property
    def is_known(self) -> bool:
        """Whether it says where the board lay."""
        return math.isfinite(self.sigma)


@dataclasses.dataclass(frozen=True)
class Session:
    """Board, given windows and known places.

    Attributes
    ----------
    board : CharucoBoard
        The board of all images.
    windows : pair of Window
        Of the left and the right camera; what the images do not tell of them is kept.
    places : dict of str to Place
        By file name without ending; `*` and `?` as in a shell.
    """

    board: CharucoBoard
    windows: tuple[Window, Window]
    places: dict[str, Place]

    def place_of(self, *names: str) -> Place | None:
        """Return where the board of an image lay; None where it was held freely.

        Parameters
        ----------
        *names : str
            What the image may be called: file names without ending.
        """
        exact = [name for name in names if name in self.places]
        like = [key for key in self.places if any(fnmatch.fnmatchcase(n, key) for n in names)]
        return next((self.places[key] for key in exact + like), None)


def load_session(path: Path) -> Session:
    """Read and check a session file.

    Parameters
    ----------
    path : Path
        YAML: `board`, `phantom` or the cameras' windows, `places` (docs/calibration.md).

    Returns
    -------
    Session
        What it says.

    Raises
    ------
    UserError
        Unreadable, not YAML, an unknown key, or a value missing or out of bounds.
    """
    content = read_yaml(path)
    try:
        return parse_session(content)
    except UserError as error:
        raise UserError(f"session {path}: {error}") from error


def parse_session(content: Any) -> Session:
    """Check the content of a session file.

    Parameters
    ----------
    content : mapping
        The file's content.

    Returns
    -------
    Session
        What it says.

    Raises
    ------
    UserError
        An unknown key, or a value missing or out of bounds.
    """
    top = _mapping(content, "the file", ("board", "phantom", *SIDES, "places"))
    for key, known in (("phantom", _SURFACE_KEYS), *((side, ("window",)) for side in SIDES)):
        if key in top:
            _mapping(top[key], key, known)
    windows = parse_windows(top)
    content = top.get("places") or {}
    if not isinstance(content, dict):
        raise UserError(f"places = {content!r} is not a mapping of file names")
    board = _board(top.get("board"))
    places = {str(name): _place(value, f"places.{name}") for name, value in content.items()}
    for name, place in places.items():
        if place.is_known:
            _check_side(f"places.{name}", place, board, windows)
    return Session(board, windows, places)


def _check_side(
    name: str, place: Place, board: CharucoBoard, windows: tuple[Window, Window]
) -> None:
    """Refuse a board that cannot be seen, or is not wholly on the side that is said."""
    T = place.T_rig_board  # noqa: N806
    corners = board.corners @ T[:3, :3].T + T[:3, 3]
    for window in windows:
        if float(T[:3, 2] @ window.normal) >= 0.0:
            raise UserError(
                f"{name}: with these columns and rows the board's print faces downwards, away from "
                "the camera"
            )
        depth = window.depth(corners)
        if place.under_surface and float(depth.min()) <= 0.0:
            raise UserError(
                f"{name} is under_surface, but reaches {-1e3 * depth.min():.1f} mm above the "
                "surface"
            )
    # Where each camera has a window of its own, a board in air is there before the phantom is.
    above = common_surface(*windows) is None or float(depth.max()) <= 1e-3
    if not (place.under_surface or above):
        raise UserError(
            f"{name} reaches {1e3 * depth.max():.1f} mm below the surface: under_surface: true?"
        )


def _board(content: Any) -> CharucoBoard:
    board = _mapping(content, "board", _BOARD_KEYS)
    columns, rows, square, marker = (
        number({"board": board}, "board", key) for key in _BOARD_KEYS[:4]
    )
    if not (columns.is_integer() and rows.is_integer()):
        raise UserError(f"board.columns, board.rows = {columns:g}, {rows:g} are not whole numbers")
    legacy = _flag(board, "board", "legacy")
    dictionary = str(board.get("dictionary"))
    return CharucoBoard(int(columns), int(rows), square, marker, dictionary, legacy)


def _place(content: Any, name: str) -> Place:
    place = _mapping(content, name, _PLACE_KEYS)
    under = _flag(place, name, "under_surface")
    if under and set(place) == {"under_surface"}:
        return Place(np.eye(4), under, math.inf)
    entry = {name: {"columns": [0.0, 0.0, 1.0], "rows": [0.0, 1.0, 0.0], "sigma": 0.0} | place}
    origin, along, across = (numbers(entry, 3, name, key) for key in ("origin", "columns", "rows"))
    sigma = number(entry, name, "sigma")
    check_bounds(f"{name}.sigma", sigma, 0.0, 0.01, "m")
    x, y = (v / max(float(np.linalg.norm(v)), 1e-12) for v in (along, across))
    if float(np.linalg.norm(np.cross(x, y))) < _LEAST_SINE:
        raise UserError(f"{name}: columns {along} and rows {across} are not at right angles")
    y = y - x * float(x @ y)
    transform = np.eye(4)
    transform[:3, :3] = np.stack([x, y / np.linalg.norm(y), np.zeros(3)], axis=-1)
    transform[:3, 2] = np.cross(transform[:3, 0], transform[:3, 1])
    transform[:3, 3] = origin
    return Place(transform, under, sigma)


def _mapping(content: Any, name: str, keys: tuple[str, ...]) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise UserError(f"{name} is missing or not a mapping")
    for key in content:
        if key not in keys:
            raise UserError(f"{name} has an unknown key {key!r} (known: {', '.join(keys)})")
    return content


def _flag(content: dict[str, Any], name: str, key: str) -> bool:
    value = content.get(key, False)
    if not isinstance(value, bool):
        raise UserError(f"{name}.{key} = {value!r} is not true or false")
    return value
