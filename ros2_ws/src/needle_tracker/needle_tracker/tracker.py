"""Stereo pair in, tip out: detection in both views, triangulation, gates, track.

The result depends on the images and insertions given so far and on nothing else: no time, no
randomness, one thread.
"""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np

from needle_tracker.calibration import SIDES, Phantom, StereoCalibration
from needle_tracker.detection import (
    DetectionSettings,
    Image,
    Path,
    Window,
    columns_within,
    find_path,
    full_window,
)
from needle_tracker.refraction import RefractedCamera
from needle_tracker.search_grid import Reach, SearchGrid, make_search_grid
from needle_tracker.tip_fit import ImageTip, fit_tip
from needle_tracker.track import GateSettings, Track, TrackState, tip_at_entry
from needle_tracker.triangulation import SpatialTip, triangulate

_REGION_BEHIND = 14e-3  # the region covers the pre-bend (9 mm) and some of the shaft [m]
_REGION_AHEAD = 3e-3
_REGION_SIDEWAYS = 3e-3
_START_SIDEWAYS = 2e-3


@dataclasses.dataclass(frozen=True)
class TrackerSettings:
    """Everything that the tracker is told beside the calibration.

    Attributes
    ----------
    gates : GateSettings
        Bounds that a believed tip keeps.
    needle_width : float
        Diameter of the needle [m].
    bright : bool
        Whether it is brighter than its surroundings.
    min_contrast : float
        Least contrast [grey levels].
    noise_factor : float
        Ridge threshold in standard deviations of the noise.
    entry_zone : float
        Insertion below which the needle is not looked for [m].
    hole_clearance : float
        Radius around the entry that is not looked at [m].
    """

    gates: GateSettings
    needle_width: float
    bright: bool
    min_contrast: float
    noise_factor: float
    entry_zone: float
    hole_clearance: float


def default_settings(phantom: Phantom) -> TrackerSettings:
    """Return the settings for the needle of [KC09] section II (0.7 mm, 10 deg pre-bend).

    Parameters
    ----------
    phantom : Phantom
        From the calibration.

    Returns
    -------
    TrackerSettings
        The same as the node's defaults.
    """
    hole_clearance = 2.0e-3
    gates = GateSettings(
        reach=Reach(curvature=9.0, entry_angle=0.1745, hole_tolerance=0.5e-3, length=0.15),
        surface_height=phantom.surface_height,
        least_distance=hole_clearance + 1.5e-3,
        tip_lean=0.21,
        insertion_margin=2.0e-3,
        step_margin=1.5e-3,
        free_step=5.0e-3,
        max_disagreement=1.5e-3,
        max_miss_px=1.0,
        max_depth_sigma=2e-3,
        confirm_pairs=3,
        lost_after=3,
        forget_after=30,
    )
    return TrackerSettings(
        gates=gates,
        needle_width=0.7e-3,
        bright=False,
        min_contrast=10.0,
        noise_factor=5.0,
        entry_zone=4.5e-3,
        hole_clearance=hole_clearance,
    )


@dataclasses.dataclass(frozen=True)
class Measurement:
    """What a pair of images gave.

    Attributes
    ----------
    tip : SpatialTip or None
        The believed tip; None where there is none.
    state : TrackState
        State of the track after this pair.
    reason : str
        Why there is no believed tip; empty where there is one.
    image_tips : pair of (ImageTip or None)
        What was found in the left and the right image, believed or not.
    paths : pair of (Path or None)
        Coarse paths behind `image_tips`.
    """

    tip: SpatialTip | None
    state: TrackState
    reason: str
    image_tips: tuple[ImageTip | None, ImageTip | None] = (None, None)
    paths: tuple[Path | None, Path | None] = (None, None)


class StereoTracker:
    """Tracks the tip through a sequence of stereo pairs.

    Parameters
    ----------
    calibration : StereoCalibration
        The stereo rig.
    settings : TrackerSettings
        What else is known.
    """

    def __init__(self, calibration: StereoCalibration, settings: TrackerSettings) -> None:
        # Results must not depend on how many cores there are.
        cv2.setNumThreads(1)
        cameras = (calibration.left, calibration.right)
        self.settings = settings
        self.views = (
            RefractedCamera(cameras[0], calibration.phantom),
            RefractedCamera(cameras[1], calibration.phantom),
        )
        self.grids = (self._grid(self.views[0]), self._grid(self.views[1]))
        self._detection = (self._look(self.views[0]), self._look(self.views[1]))
        self._shapes = tuple((camera.height, camera.width) for camera in cameras)
        self.track = Track(settings.gates)
        self._paths: tuple[Path, Path] | None = None

    def reset(self) -> None:
        """Forget the track."""
        self.track.reset()
        self._paths = None

    def process(self, left: Image, right: Image, insertion: float | None) -> Measurement:
        """Measure the tip in a stereo pair.

        Parameters
        ----------
        left, right : ndarray of uint8, shape (height, width)
            Images of one exposure, of the calibration's size.
        insertion : float or None
            Length of needle beyond the entry point at the exposure [m], None where unknown.

        Returns
        -------
        Measurement
            With or without a tip.

        Raises
        ------
        ValueError
            An image of another size than the calibration's.
        """
        images = (left, right)
        for side, image, shape in zip(SIDES, images, self._shapes, strict=True):
            if image.shape != shape or image.dtype != np.uint8:
                raise ValueError(f"{side} image is {image.dtype}{image.shape}, wants uint8{shape}")
        for side, image in zip(SIDES, images, strict=True):
            if int(image[::8, ::8].max()) < self.settings.min_contrast:
                return self.skip(f"{side} image is black")
        if insertion is not None and insertion < self.settings.entry_zone:
            self._paths = None
            self.track.enter()
            tip = tip_at_entry(
                insertion,
                self.settings.gates.reach.hole_tolerance,
                self.settings.gates.reach.entry_angle,
            )
            return Measurement(tip, self.track.state, "")
        windows = self._region(insertion)
        measured = None
        if windows is not None:
            measured = self._measure(images, windows, insertion)
        if measured is None or measured.tip is None:
            measured = self._measure(images, self._everywhere(insertion), insertion)
        if measured.tip is None:
            self._paths = None if self.track.state is not TrackState.TRACKING else self._paths
            self.track.miss()
            return dataclasses.replace(measured, state=self.track.state)
        believed = self.track.accept(measured.tip, insertion)
        found = measured.paths
        if found[0] is not None and found[1] is not None:
            self._paths = (found[0], found[1])
        if not believed:
            return dataclasses.replace(
                measured, tip=None, state=self.track.state, reason="not confirmed yet"
            )
        return dataclasses.replace(measured, state=self.track.state)

    def skip(self, reason: str) -> Measurement:
        """Answer a pair that cannot be looked at; it counts as one without a tip."""
        self.track.miss()
        return Measurement(None, self.track.state, reason)

    def _measure(
        self, images: tuple[Image, Image], windows: tuple[Window, Window], insertion: float | None
    ) -> Measurement:
        tips: list[ImageTip | None] = [None, None]
        paths: list[Path | None] = [None, None]
        reason = ""
        for i, side in enumerate(SIDES):
            path = find_path(images[i], self.grids[i], windows[i], self._detection[i])
            paths[i] = path
            if path is None:
                reason = reason or f"no needle in the {side} image"
                continue
            tips[i] = fit_tip(images[i], path, self._detection[i])
            if tips[i] is None:
                reason = reason or f"no clear tip in the {side} image"
        found = (tips[0], tips[1])
        routes = (paths[0], paths[1])
        state = self.track.state
        if found[0] is None or found[1] is None:
            return Measurement(None, state, reason, found, routes)
        tip = triangulate(self.views, (found[0], found[1]))
        if tip is None:
            return Measurement(None, state, "views do not meet", found, routes)
        refused = self.track.judge(tip, insertion)
        if refused is not None:
            return Measurement(None, state, refused, found, routes)
        return Measurement(tip, state, "", found, routes)

    def _everywhere(self, insertion: float | None) -> tuple[Window, Window]:
        """Windows of all that can be reached (with this insertion, where known)."""
        windows = []
        for grid in self.grids:
            last = None
            if insertion is not None:
                last = grid.row_of(insertion + self.settings.gates.insertion_margin + 3e-3)
            windows.append(full_window(grid, last))
        return windows[0], windows[1]

    def _region(self, insertion: float | None) -> tuple[Window, Window] | None:
        """Windows around the predicted tip, None without a prediction."""
        predicted = self.track.predict(insertion)
        if predicted is None or self._paths is None:
            return None
        windows = []
        for view, grid, path in zip(self.views, self.grids, self._paths, strict=True):
            # Where the camera sees the predicted tip, in the plane of the grid.
            origin, direction = view.rays(view.project(predicted.position))
            if not np.all(np.isfinite(direction)):
                return None
            seen = origin - direction * (origin[0] / direction[0])
            distance = math.hypot(float(seen[1]), float(seen[2]))
            first = max(grid.row_of(distance - _REGION_BEHIND), int(path.rows[0]))
            last = grid.row_of(distance + _REGION_AHEAD)
            if first >= int(path.rows[-1]) or last - first < 4:
                return None
            body = path.columns[int(np.searchsorted(path.rows, first)) :]
            angle = math.atan2(float(seen[1]), float(seen[2]))
            column = round((angle - float(grid.angles[0])) / grid.angle_pitch)
            room = columns_within(grid, float(grid.distances[first]), _REGION_SIDEWAYS)
            windows.append(
                Window(
                    first,
                    last,
                    int(body[0]),
                    columns_within(grid, float(grid.distances[first]), _START_SIDEWAYS),
                    max(min(int(body.min()), column) - room, 0),
                    min(max(int(body.max()), column) + room, len(grid.angles) - 1),
                )
            )
        return windows[0], windows[1]

    def _grid(self, view: RefractedCamera) -> SearchGrid:
        return make_search_grid(
            view, self.settings.gates.reach, first_distance=self.settings.hole_clearance
        )

    def _look(self, view: RefractedCamera) -> DetectionSettings:
        settings = self.settings
        middle = np.array([0.0, 0.0, 0.5 * settings.gates.reach.length])
        pixels_per_metre = float(np.linalg.norm(view.jacobian(middle)[:, 1:], axis=0).mean())
        return DetectionSettings(
            bright=settings.bright,
            needle_width_px=settings.needle_width * pixels_per_metre,
            min_contrast=settings.min_contrast,
            noise_factor=settings.noise_factor,
        )
