"""From images to what both cameras saw of the board."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from needle_core.errors import UserError
from needle_tracker.calibrating.calibration_session import Session
from needle_tracker.calibrating.rig_model import BoardView, Corners
from needle_tracker.optics.calibration import SIDES
from needle_tracker.sources.image_files import Image, Sizes, open_pairs, progress

Array = NDArray[np.float64]


def views_in_folders(
    left: Path, right: Path, session: Session, *, all_places: bool = True
) -> tuple[list[BoardView], Sizes]:
    """Find the board in all image pairs of two folders.

    Parameters
    ----------
    left, right : Path
        Folders of images paired by name, or two videos (names: the frames' numbers).
    session : Session
        Board and places.
    all_places : bool
        Whether each of the session's places must have an image.

    Returns
    -------
    views : list of BoardView
        One for each pair, in the order of the names.
    sizes : dict of str to (int, int)
        Width and height of each side's images.

    Raises
    ------
    UserError
        Folders, names or files that are wrong, images of different sizes, another board or none, a
        place in the session that no image has.
    """
    views: list[BoardView] = []
    sizes: Sizes = {}
    pairs = open_pairs(left, right).refuse_unpaired()
    for pair in progress(pairs, "finding the board"):
        seen = []
        for side, path, image in zip(SIDES, pair.files, (pair.left, pair.right), strict=True):
            if image is None:
                raise UserError(f"cannot read {path}: not an image in 8 bit")
            size = (image.shape[1], image.shape[0])
            if sizes.setdefault(side, size) != size:
                raise UserError(
                    f"{path} is {size[0]}x{size[1]}, the {side} images before it "
                    f"are {sizes[side][0]}x{sizes[side][1]}"
                )
            numbers, pixels = session.board.find(image)
            seen.append(Corners(session.board.corners[numbers], pixels))
        names = [Path(path).stem for path in (pair.name, *pair.files)]
        views.append(BoardView(names[0], session.place_of(*names), *seen))
    if all(nothing_seen(view) for view in views):
        raise _no_board(session)
    used = [view.place for view in views]
    for name, place in session.places.items():
        if all_places and not any(place is one for one in used):
            raise UserError(f"the session's places.{name} has no image in {left}")
    return views, sizes


def nothing_seen(view: BoardView) -> bool:
    """Return whether neither camera saw the board."""
    return not np.any([len(view.corners(side).points) for side in SIDES])


def averaged_view(name: str, session: Session, pairs: list[dict[str, Image]]) -> BoardView:
    """Return what both cameras saw of a board that stood still, the mean of several exposures.

    Parameters
    ----------
    name : str
        The view's name; the session says by it where the board lay.
    session : Session
        Board and places.
    pairs : list of dict of str to ndarray
        Left and right images.
    """
    seen = []
    for side in SIDES:
        found: dict[int, list[Array]] = {}
        for images in pairs:
            for number, pixel in zip(*session.board.find(images[side]), strict=True):
                found.setdefault(int(number), []).append(pixel)
        # A corner that only some exposures show is at the border of what can be seen.
        kept = sorted(n for n, pixels in found.items() if 2 * len(pixels) > len(pairs))
        pixels = np.array([np.mean(found[n], axis=0) for n in kept]).reshape(-1, 2)
        seen.append(Corners(session.board.corners[kept], pixels))
    view = BoardView(name, session.place_of(name), seen[0], seen[1])
    if nothing_seen(view):
        raise _no_board(session)
    return view


def _no_board(session: Session) -> UserError:
    return UserError(
        f"no image shows the session's board ({session.board}): are columns, rows and dictionary "
        "those of the print, and `legacy` if OpenCV before 4.6 made it? blurred, or too small?"
    )
