"""The tracker beside the plain OpenCV way, on the same rendered pairs: speeds and errors."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import needle_tracker
from campaign.tracking.tracker_study import Exposure, insertion_sequence, new_tracker, track_run
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_tracker.optics.calibration import Camera, StereoCalibration, load_calibration

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SCENARIO = "clean"
PAIRS = 60
_DIFFERENCE = 25  # [grey levels]


@dataclass(frozen=True)
class Way:
    """One way to find the tip: its key, speed [pairs/s] and 95 % error [mm]."""

    key: str
    what: str
    pairs_per_s: float
    distance_p95_mm: float


class PlainTracker:
    """Track as is written first: undistort, subtract the empty image, farthest pixel, rays.

    Parameters
    ----------
    calibration : StereoCalibration
        The rig.
    empty : pair of ndarray of uint8
        Images without a needle.
    """

    def __init__(self, calibration: StereoCalibration, empty: tuple[Image, Image]) -> None:
        self._window = calibration.left.window
        self._cameras = (calibration.left, calibration.right)
        self._empty = tuple(
            self._undistorted(camera, image)
            for camera, image in zip(self._cameras, empty, strict=True)
        )
        self._projections = [c.camera_matrix @ c.T_optical_rig[:3] for c in self._cameras]
        self._entries = [(p @ [0.0, 0.0, 0.0, 1.0]) for p in self._projections]

    def tip(self, pair: tuple[Image, Image], corrected: bool) -> Array:
        """Return the tip in `rig` [m], NaN where nothing is found."""
        points = []
        for i, image in enumerate(pair):
            changed = cv2.absdiff(self._undistorted(self._cameras[i], image), self._empty[i])
            _, mask = cv2.threshold(changed, _DIFFERENCE, 255, cv2.THRESH_BINARY)
            count, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
            if count < 2:
                return np.full(3, np.nan)
            largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
            rows, columns = np.nonzero(labels == largest)
            entry = self._entries[i][:2] / self._entries[i][2]
            far = int(np.argmax(np.hypot(columns - entry[0], rows - entry[1])))
            points.append(np.array([[columns[far]], [rows[far]]], dtype=np.float64))
        found = cv2.triangulatePoints(*self._projections, *points).reshape(4)
        tip = np.asarray(found[:3] / found[3], dtype=np.float64)
        if corrected:
            # What lies deep seems to lie at its depth over the index.
            surface = self._window.point[0]
            tip[0] = surface - (surface - tip[0]) * self._window.inside
        return tip

    @staticmethod
    def _undistorted(camera: Camera, image: Image) -> Image:
        return np.asarray(cv2.undistort(image, camera.camera_matrix, camera.distortion))


def ways() -> list[Way]:
    """Measure all ways on the same pairs, one thread each."""
    cv2.setNumThreads(1)
    package = Path(needle_tracker.__file__).resolve().parents[1]
    path = package / "config" / "calibration.yaml"
    exposures = list(insertion_sequence(path, SCENARIO, 1, PAIRS))
    bare = _without_needle(path)
    plain = PlainTracker(load_calibration(path), bare)
    tracker = new_tracker(load_calibration(path))
    tracker.warm_up()
    found = []
    for key, what, searching in (
        ("full", "tracker, full frame", True),
        ("region", "tracker, region", False),
    ):
        run = track_run(tracker, exposures, searching=searching)
        seconds = float(np.median(run.seconds))
        found.append(_way(key, what, seconds, run.errors))
    for key, what, corrected in (
        ("plain", "plain OpenCV", False),
        ("plain_corrected", "plain OpenCV, corrected after", True),
    ):
        errors, seconds = _run_plain(partial(plain.tip, corrected=corrected), exposures)
        found.append(_way(key, what, seconds, errors))
    return found


def _without_needle(path: Path) -> tuple[Image, Image]:
    """Return the clean scene before the needle is in it, as a rig's owner would take it."""
    return StereoRenderer(load_stereo_rig(path), 1).render(np.eye(4), np.zeros((1, 3)), 0)


def _run_plain(
    find: Callable[[tuple[Image, Image]], Array], exposures: Sequence[Exposure]
) -> tuple[Array, float]:
    errors, seconds = [], []
    for exposure in exposures:
        begin = time.thread_time()
        tip = find((exposure.left, exposure.right))
        seconds.append(time.thread_time() - begin)
        errors.append(tip - exposure.T_rig_tip[:3, 3])
    return np.array(errors), float(np.median(seconds))


def _way(key: str, what: str, seconds: float, errors: Array) -> Way:
    good = errors[np.all(np.isfinite(errors), axis=1)] * 1e3
    distance = np.linalg.norm(good, axis=1)
    return Way(key, what, 1.0 / seconds, float(np.percentile(distance, 95)))
