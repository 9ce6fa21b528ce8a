"""Training scenes from a recording of a rig, labelled by the tracker."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from needle_bringup.training.traced_scenes import TracedScene, shaft_share
from needle_core.commands.csv_files import read_insertions
from needle_core.errors import UserError
from needle_sim.camera.stereo_rig import StereoRig, load_stereo_rig
from needle_tracker.filter.needle_tracker import NeedleTracker
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.sources.image_files import open_pairs
from needle_tracker.tracker_parameters import StereoTrackerParameters

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_LEAST_TIPS = 10  # minimum number of tips for the fit of the path
_MOST_PAIRS = 60  # maximum number of pairs per scene, to limit memory
_EVERY = 5  # one pair in this many is held out
_HOLE_SIGMA, _TIP_SIGMA = 0.3e-3, 0.2e-3  # sigma of the path at the entry, and of a tip [m]
_PASSES, _POINTS = 5, 60  # iterations of the fit; points of a drawn shaft
_SHORT = 10e-3  # assumed needle length to compute the width in images without a needle [m]


def own_scenes(folder: Path, width: float) -> tuple[TracedScene, TracedScene]:
    """Return the training scene and the held-out scene of a recording.

    The needle follows its tip, so the path of the accepted tips gives the shaft in each image,
    including those between them without a tip.

    Parameters
    ----------
    folder : Path
        Folder with calibration.yaml; empty/left and empty/right, images of an insertion without a
        needle; needle/left, needle/right and needle/insertion.csv, the same with a needle.
    width : float
        Diameter of the needle [m].

    Raises
    ------
    UserError
        If a file is missing, or too few tips were accepted.
    """
    calibration = load_calibration(folder / "calibration.yaml")
    parameters = StereoTrackerParameters(needle_width=width)
    rig = load_stereo_rig(folder / "calibration.yaml")
    tracker = NeedleTracker(calibration, parameters)
    empty = _pairs(folder / "empty", {})
    tracker.process(*empty[0].images, 0.0)
    known = read_insertions(folder / "needle" / "insertion.csv")
    shown = [
        pair
        for pair in _pairs(folder / "needle", known)
        if pair.insertion is not None and pair.insertion >= parameters.entry_zone
    ]
    tips = [tracker.process(*pair.images, pair.insertion).tip for pair in shown]
    insertions = np.array([pair.insertion for pair in shown], np.float64)
    believed = np.array([tip is not None for tip in tips], np.bool_)
    if believed.sum() < _LEAST_TIPS:
        raise UserError(
            f"{folder}: the tracker accepted {believed.sum()} tips of {len(tips)} pairs, and "
            f"{_LEAST_TIPS} are needed to locate the needle; `track_images` gives the reasons"
        )
    path = TipPath(insertions[believed], np.array([tip.position for tip in tips if tip]))
    least, most = insertions[believed].min(), insertions[believed].max()
    labelled = [pair for pair in shown if least <= (pair.insertion or 0.0) <= most]
    learned = [pair for n, pair in enumerate(labelled) if n % _EVERY]
    return (
        _scene(rig, width, path, empty[0], empty[1::2] + learned),
        _scene(rig, width, path, empty[0], empty[2::2] + labelled[::_EVERY]),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class OwnPair:
    """Left and right image of one exposure, and the insertion [m] if there is a needle."""

    images: tuple[Image, Image]
    insertion: float | None


class TipPath:
    """Path of the tip as a cubic function of the insertion, through the entry.

    Parameters
    ----------
    insertions : ndarray, shape (n,)
        Insertions of the tips [m].
    tips : ndarray, shape (n, 3)
        Positions of the tips in `rig` [m].
    """

    def __init__(self, insertions: Array, tips: Array) -> None:
        self._scale = float(insertions.max())
        s = np.append(insertions, 0.0)
        terms, points = self._terms(s), np.vstack([tips, np.zeros(3)])
        sigmas = np.append(np.full(len(tips), _TIP_SIGMA), _HOLE_SIGMA)
        weights = 1.0 / sigmas
        # Iteratively reweighted least squares give outliers a low weight.
        for _ in range(_PASSES):
            rows = weights[:, None]
            self._cubic, *_ = np.linalg.lstsq(terms * rows, points * rows, rcond=None)
            off = np.linalg.norm(points - terms @ self._cubic, axis=1) / sigmas
            weights = 1.0 / (sigmas * (1.0 + off**2))

    def shaft(self, insertion: float) -> Array:
        """Return points along the shaft, from the entry to the tip, shape (n, 3) [m]."""
        return np.asarray(self._terms(np.linspace(0.0, insertion, _POINTS)) @ self._cubic)

    def _terms(self, insertions: Array) -> Array:
        return np.vander(insertions / self._scale, 4, increasing=True)


def _scene(
    rig: StereoRig, width: float, path: TipPath, empty: OwnPair, pairs: list[OwnPair]
) -> TracedScene:
    """Return a scene of image pairs, of which the first has no needle."""
    step = -(-len(pairs) // _MOST_PAIRS)
    images, shares, ends, widths = [], [], [], []
    for pair in [empty, *pairs[::step]]:
        for camera, image in zip((rig.left, rig.right), pair.images, strict=True):
            line = path.shaft(pair.insertion or _SHORT)
            share, end, width_px = shaft_share(line[line[:, 2] > 0.0], width, camera)
            if pair.insertion is None:
                share, end = np.zeros_like(image), np.full(2, np.nan)
            images.append(image)
            shares.append(share)
            ends.append(end)
            widths.append(width_px)
    return TracedScene(np.stack(images), np.stack(shares), np.stack(ends), np.array(widths))


def _pairs(folder: Path, insertions: Mapping[str, float]) -> list[OwnPair]:
    """Return the readable pairs of a folder.

    Raises
    ------
    UserError
        If no pair is readable.
    """
    found = []
    for pair in open_pairs(folder / "left", folder / "right"):
        if pair.left is not None and pair.right is not None:
            found.append(OwnPair((pair.left, pair.right), pair.number_in(insertions)))
    if not found:
        raise UserError(f"{folder}: no pair can be read")
    return found
