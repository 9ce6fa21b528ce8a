"""Speed and error of the tracker compared with plain OpenCV, on the same rendered pairs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import needle_tracker
from campaign.benchmarks.figure_rows import Row
from campaign.tracking.tracker_study import Exposure, insertion_sequence, new_tracker, track_run
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_tracker.optics.calibration import Camera, StereoCalibration, load_calibration

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SCENARIO = "clean"
PAIRS = 60
_DIFFERENCE = 25  # [grey levels]


class PlainTracker:
    """Plain OpenCV tracker: undistort, subtract the empty image, farthest pixel, triangulate.

    Parameters
    ----------
    calibration : StereoCalibration
        Calibration of the rig.
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
        """Return the tip in `rig` [m]; NaN if no tip is found."""
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
            # By refraction, the apparent depth is the true one divided by the refractive index.
            surface = self._window.point[0]
            tip[0] = surface - (surface - tip[0]) * self._window.inside
        return tip

    @staticmethod
    def _undistorted(camera: Camera, image: Image) -> Image:
        return np.asarray(cv2.undistort(image, camera.camera_matrix, camera.distortion))


def rows() -> Iterator[Row]:
    """Yield time and 95 % error of the tracker and plain OpenCV, on the same pairs, one thread."""
    cv2.setNumThreads(1)
    package = Path(needle_tracker.__file__).resolve().parents[1]
    path = package / "config" / "calibration.yaml"
    exposures = list(insertion_sequence(path, SCENARIO, 1, PAIRS))
    plain = PlainTracker(load_calibration(path), _without_needle(path))
    references = [
        (name, *_run_plain(partial(plain.tip, corrected=corrected), exposures))
        for name, corrected in (("plain OpenCV", False), ("plain OpenCV, corrected after", True))
    ]
    tracker = new_tracker(load_calibration(path))
    tracker.warm_up()
    for key, what, searching in (
        ("tracker_full", "tracker, full frame", True),
        ("tracker_region", "tracker, region", False),
    ):
        run = track_run(tracker, exposures, searching=searching)
        seconds, error = float(np.median(run.seconds)), _p95_mm(run.errors)
        for name, plain_seconds, plain_error in references:
            pair = f"{what}, a pair ({1.0 / seconds:.0f}/s)"
            yield Row(f"{key}_pair", pair, "ms", 1e3 * seconds, name, 1e3 * plain_seconds)
            yield Row(f"{key}_error", f"{what}, 95 % error", "mm", error, name, plain_error)


def _without_needle(path: Path) -> tuple[Image, Image]:
    """Render the clean scene without the needle."""
    return StereoRenderer(load_stereo_rig(path), 1).render(np.eye(4), np.zeros((1, 3)), 0)


def _run_plain(
    find: Callable[[tuple[Image, Image]], Array], exposures: Sequence[Exposure]
) -> tuple[float, float]:
    """Return the median time of a pair [s] and the 95 % error [mm]."""
    errors, seconds = [], []
    for exposure in exposures:
        begin = time.thread_time()
        tip = find((exposure.left, exposure.right))
        seconds.append(time.thread_time() - begin)
        errors.append(tip - exposure.T_rig_tip[:3, 3])
    return float(np.median(seconds)), _p95_mm(np.array(errors))


def _p95_mm(errors: Array) -> float:
    found = errors[np.all(np.isfinite(errors), axis=1)] * 1e3
    return float(np.percentile(np.linalg.norm(found, axis=1), 95))
