"""Session of a calibration: the board, its known places, and its views in images."""

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
    Window,
    common_surface,
    number,
    numbers,
    parse_windows,
    pose_matrix,
)
from needle_tracker.sources.image_files import Image, Sizes, open_pairs, progress

Array = NDArray[np.float64]

_LEAST_SINE = math.cos(math.radians(5.0))
_PLACE_KEYS = ("origin", "columns", "rows", "under_surface", "sigma")
_SURFACE_KEYS = ("surface_height", "refractive_index")
KINDS = ("free", "surface", "under")
_BOARD_KEYS = ("columns", "rows", "square", "marker", "dictionary", "legacy")


@dataclasses.dataclass(frozen=True)
class Place:
    """Place of a board.

    Attributes
    ----------
    T_rig_board : ndarray, shape (4, 4)
        Transforms points of the board to `rig` [m].
    under_surface : bool
        Whether the board was in the phantom, so that light is refracted.
    sigma : float
        Standard deviation of the coordinates [m]; 0: exact, the place defines `rig`; infinite: held
        freely, `T_rig_board` is meaningless.
    """

    T_rig_board: Array
    under_surface: bool = False
    sigma: float = 0.0

    @property
    def is_known(self) -> bool:
        """Whether the position of the board is known."""
        return math.isfinite(self.sigma)


HELD_FREELY = Place(np.eye(4), sigma=math.inf)
"""Place of a board held freely in air."""


@dataclasses.dataclass(frozen=True)
class Corners:
    """Corners detected by one camera: in the board's frame [m] (n, 3), and in pixels (n, 2)."""

    points: Array
    pixels: Array


@dataclasses.dataclass(frozen=True)
class BoardView:
    """One exposure of the board by both cameras."""

    name: str
    place: Place
    left: Corners
    right: Corners

    def corners(self, side: str) -> Corners:
        """Return the corners detected by the camera of one side."""
        return self.left if side == "left" else self.right

    def without(self, side: str) -> BoardView:
        """Return the view without the corners of one side."""
        nothing = Corners(np.zeros((0, 3)), np.zeros((0, 2)))
        left, right = (nothing if s == side else self.corners(s) for s in SIDES)
        return dataclasses.replace(self, left=left, right=right)

    @property
    def kind(self) -> str:
        """Kind of view in `KINDS`: held freely, at a known place in air, or in the phantom."""
        if self.place.under_surface:
            return "under"
        return "surface" if self.place.is_known else "free"


@dataclasses.dataclass(frozen=True)
class Session:
    """Board, given windows and known places.

    Attributes
    ----------
    board : CharucoBoard
        Board of all images.
    windows : pair of Window
        Given windows of the left and the right camera.
    places : dict of str to Place
        Places by file name without suffix; `*` and `?` match as in a shell.
    """

    board: CharucoBoard
    windows: tuple[Window, Window]
    places: dict[str, Place]

    def place_of(self, *names: str) -> Place:
        """Return the place of the board in an image, `HELD_FREELY` if the session has none.

        Parameters
        ----------
        *names : str
            Possible names of the image: file names without suffix.
        """
        exact = [name for name in names if name in self.places]
        like = [key for key in self.places if any(fnmatch.fnmatchcase(n, key) for n in names)]
        return next((self.places[key] for key in exact + like), HELD_FREELY)


def load_session(path: Path) -> Session:
    """Read and check a session file.

    Parameters
    ----------
    path : Path
        YAML: `board`, `phantom` or the cameras' windows, `places` (docs/calibration.md).

    Returns
    -------
    Session
        The session.

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
        Content of the file.

    Returns
    -------
    Session
        The session.

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
    board = _board(top)
    places = {str(name): _place(value, f"places.{name}") for name, value in content.items()}
    for name, place in places.items():
        if place.is_known:
            _check_side(f"places.{name}", place, board, windows)
    return Session(board, windows, places)


def _check_side(
    name: str, place: Place, board: CharucoBoard, windows: tuple[Window, Window]
) -> None:
    """Reject a board that is invisible, or not entirely on the given side of the surface."""
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
    # If each camera has its own window, a board in air may be in the place of the phantom.
    above = common_surface(*windows) is None or float(depth.max()) <= 1e-3
    if not (place.under_surface or above):
        raise UserError(
            f"{name} reaches {1e3 * depth.max():.1f} mm below the surface: under_surface: true?"
        )


def _board(top: dict[str, Any]) -> CharucoBoard:
    board = _mapping(top.get("board"), "board", _BOARD_KEYS)
    columns, rows, square, marker = (number(top, "board", key) for key in _BOARD_KEYS[:4])
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
    y /= np.linalg.norm(y)
    return Place(pose_matrix(np.stack([x, y, np.cross(x, y)], axis=-1), origin), under, sigma)


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


def views_in_folders(
    left: Path, right: Path, session: Session, *, all_places: bool = True
) -> tuple[list[BoardView], Sizes]:
    """Find the board in all image pairs of two folders.

    Parameters
    ----------
    left, right : Path
        Folders of images paired by name, or two videos (named by frame number).
    session : Session
        Board and places.
    all_places : bool
        Whether each place of the session must have an image.

    Returns
    -------
    views : list of BoardView
        One for each pair, in the order of the names.
    sizes : dict of str to (int, int)
        Width and height of the images of each side.

    Raises
    ------
    UserError
        Bad folders, names or files, images of different sizes, a different board or none, or a
        place of the session without an image.
    """
    views: list[BoardView] = []
    sizes: Sizes = {}
    pairs = open_pairs(left, right).refuse_unpaired()
    for pair in progress(pairs, "finding the board"):
        corners = []
        for side, path, image in zip(SIDES, pair.files, (pair.left, pair.right), strict=True):
            if image is None:
                raise UserError(f"cannot read {path}: not an image in 8 bit")
            size = (image.shape[1], image.shape[0])
            if sizes.setdefault(side, size) != size:
                raise UserError(
                    f"{path} is {size[0]}x{size[1]}, the {side} images before it "
                    f"are {sizes[side][0]}x{sizes[side][1]}"
                )
            corners.append(_corners_in(image, session.board))
        names = [Path(path).stem for path in (pair.name, *pair.files)]
        views.append(BoardView(names[0], session.place_of(*names), *corners))
    if all(no_board_detected(view) for view in views):
        raise _no_board(session)
    used = [view.place for view in views]
    for name, place in session.places.items():
        if all_places and not any(place is one for one in used):
            raise UserError(f"the session's places.{name} has no image in {left}")
    return views, sizes


def no_board_detected(view: BoardView) -> bool:
    """Return whether neither camera detected the board."""
    return not np.any([len(view.corners(side).points) for side in SIDES])


def averaged_view(name: str, session: Session, pairs: list[tuple[Image, Image]]) -> BoardView:
    """Return the view of a board at rest, from the mean of several exposures.

    Parameters
    ----------
    name : str
        Name of the view, by which the session gives the place of the board.
    session : Session
        Board and places.
    pairs : list of (ndarray, ndarray)
        Left and right images.
    """
    means = (
        np.rint(np.mean(images, axis=0)).astype(np.uint8) for images in zip(*pairs, strict=True)
    )
    corners = (_corners_in(image, session.board) for image in means)
    view = BoardView(name, session.place_of(name), *corners)
    if no_board_detected(view):
        raise _no_board(session)
    return view


def _corners_in(image: Image, board: CharucoBoard) -> Corners:
    numbers, pixels = board.find(image)
    return Corners(board.corners[numbers], pixels)


def _no_board(session: Session) -> UserError:
    return UserError(
        f"no image shows the session's board ({session.board}): are columns, rows and dictionary "
        "those of the print, and `legacy` if OpenCV before 4.6 made it? blurred, or too small?"
    )
