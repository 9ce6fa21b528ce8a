"""Stereo pair in, tip out: detection in both views, triangulation, gates, track.

The result depends on the images and insertions given so far and on nothing else: no time, no
randomness, one thread.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import cv2
import numpy as np

from needle_tracker.calibration import SIDES, Phantom, StereoCalibration
from needle_tracker.compiled_projection import project_point
from needle_tracker.detection import (
    DetectionSettings,
    Image,
    Path,
    cut_path,
    distinct,
    find_paths,
    without_shadows,
)
from needle_tracker.refraction import RefractedCamera
from needle_tracker.search_grid import Reach, SearchGrid, make_search_grid
from needle_tracker.shaft import shaft_points, shaft_problem
from needle_tracker.tip_fit import Expected, ImageTip, fit_expected, fit_tip, hidden
from needle_tracker.track import (
    DISAGREE_ALONG,
    TOO_FAR,
    UNCERTAIN,
    GateSettings,
    Track,
    TrackState,
    tip_at_entry,
)
from needle_tracker.triangulation import SpatialTip, triangulate

UNCLEAR = "not clear enough to begin with"
HIDDEN = "the end is hidden in both images"
_SIDEWAYS = 0.9e-3  # the strip reaches so far beside the prediction [m] ...
_ALONG = 0.22e-3  # ... and its end is known so well along the shaft (one sigma) [m]
# What both ends must keep to begin a track, and to begin it with the first pair [px].
_SOUND_PX, _SOUND_ALONG_PX = 0.3, 1.0
_CERTAIN_PX, _CERTAIN_ALONG_PX = 0.15, 0.6
_CONTRAST_RATIO = 2.2
# So many in a row that agree win against the track, or without one that is good.
_SOUND_RIVALS, _UNSOUND_RIVALS = 2, 3
_FOLLOW_DIRECTLY = 6e-3  # up to here the prediction is as good as the strip is wide [m]
_FOLLOW_AHEAD = 8e-3  # farther from the last tip, all is searched [m]
_CUT = 1.2e-3  # a path's length says so well where the needle ends (one sigma) [m]
_GRID_AHEAD = 1.5e-3
_GRID_MARGIN = 3e-3  # needles off the plane x = 0 appear displaced along the grid [m]


@dataclasses.dataclass(frozen=True)
class TrackerSettings:
    """Everything that the tracker is told beside the calibration.

    Attributes
    ----------
    gates : GateSettings
        Bounds that a believed tip keeps.
    needle_width : float
        Diameter of the needle [m].
    bright : bool or None
        Whether it is brighter than its surroundings; None: found out.
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
    bright: bool | None
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
        step_margin=1.0e-3,
        free_step=5.0e-3,
        max_disagreement=1.5e-3,
        max_miss_px=1.0,
        max_depth_sigma=0.5e-3,
        confirm_pairs=3,
        lost_after=10,
        forget_after=30,
    )
    return TrackerSettings(
        gates=gates,
        needle_width=0.7e-3,
        bright=None,
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
    contested : SpatialTip or None
        The tip that is not believed.
    regions : pair of (Expected or None)
        Where in the left and the right image was searched; None: everywhere, or not at all.
    """

    tip: SpatialTip | None
    state: TrackState
    reason: str
    image_tips: tuple[ImageTip | None, ImageTip | None] = (None, None)
    contested: SpatialTip | None = None
    regions: tuple[Expected | None, Expected | None] = (None, None)


def is_sound(
    found: tuple[ImageTip | None, ImageTip | None], across_px: float, along_px: float
) -> bool:
    """Return whether both views show the same needle's end well.

    Parameters
    ----------
    found : pair of (ImageTip or None)
        What the left and the right image show.
    across_px, along_px : float
        Largest standard deviations of the end [px].
    """
    left, right = found
    if left is None or right is None or not (left.clear and right.clear):
        return False
    contrasts = sorted((left.contrast, right.contrast))
    return contrasts[1] <= _CONTRAST_RATIO * contrasts[0] and all(
        tip.sigma_across <= across_px and tip.sigma_along <= along_px for tip in (left, right)
    )


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
        self._entries = tuple(view.project(np.zeros(3)) for view in self.views)
        self._shapes = tuple((camera.height, camera.width) for camera in cameras)
        self.track = Track(settings.gates)
        self._last: tuple[ImageTip, ImageTip] | None = None

    def warm_up(self) -> None:
        """Compile, or load, all that is compiled: the first pair must not wait for it."""
        tips = []
        for i, view in enumerate(self.views):
            image = np.full(self._shapes[i], 128, np.uint8)
            point = view.project(np.array([0.0, 0.0, 0.5 * self.settings.gates.reach.length]))
            direction = np.array([1.0, 0.0])
            expected = Expected(point, direction, 100.0, 6, 0.0)
            for search in (0, 6):
                where = dataclasses.replace(expected, search=search)
                fit_expected(image, where, False, self._detection[i])
            find_paths(image, self.grids[i], self._detection[i])
            tips.append(ImageTip(point, direction, 0.1, 0.1, 0.1, 50.0))
        triangulate(self.views, (tips[0], tips[1]))

    def reset(self) -> None:
        """Forget the track."""
        self.track.reset()
        self._last = None

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
        # One memory layout: compiled code is compiled for each.
        images = (_plain(left), _plain(right))
        for side, image, shape in zip(SIDES, images, self._shapes, strict=True):
            if image.shape != shape or image.dtype != np.uint8:
                raise ValueError(f"{side} image is {image.dtype}{image.shape}, wants uint8{shape}")
        for side, image in zip(SIDES, images, strict=True):
            if int(image[::8, ::8].max()) < self.settings.min_contrast:
                return self.skip(f"{side} image is black")
        if insertion is not None and insertion < self.settings.entry_zone:
            self._last = None
            self.track.enter()
            tip = tip_at_entry(
                insertion,
                self.settings.gates.reach.hole_tolerance,
                self.settings.gates.reach.entry_angle,
            )
            return Measurement(tip, self.track.state, "")
        measured = self._follow(images, insertion)
        if measured is None:
            measured = self._acquire(images, insertion)
        if measured.tip is None:
            if measured.reason in (HIDDEN, UNCERTAIN):
                self.track.hide()
            else:
                self.track.miss()
            if self.track.anchor is None:
                self._last = None
            return dataclasses.replace(measured, state=self.track.state)
        anew = measured.contested is not None
        beyond_doubt = is_sound(measured.image_tips, _CERTAIN_PX, _CERTAIN_ALONG_PX)
        believed = self.track.accept(measured.tip, insertion, anew=anew, certain=beyond_doubt)
        left_tip, right_tip = measured.image_tips
        if left_tip is not None and right_tip is not None:
            self._last = (left_tip, right_tip)
        reason = "not confirmed yet" if believed is None else ""
        return dataclasses.replace(measured, tip=believed, state=self.track.state, reason=reason)

    def skip(self, reason: str) -> Measurement:
        """Answer a pair that cannot be looked at; it counts as one without a tip."""
        self.track.miss()
        return Measurement(None, self.track.state, reason)

    def _follow(self, images: tuple[Image, Image], insertion: float | None) -> Measurement | None:
        """Look where the tip should be; None where that is not known or nothing is seen there."""
        predicted = self.track.predict(insertion)
        last = self._last
        if predicted is None or last is None or abs(predicted.ahead) > _FOLLOW_AHEAD:
            return None
        if predicted.known and not self.track.is_certain(insertion):
            return None
        known = predicted.known
        loose = 0.1 * abs(predicted.ahead)
        tips: list[ImageTip] = []
        regions: list[Expected] = []
        for i in range(2):
            point = np.empty(2)
            project_point(self.views[i].packed, predicted.motion.position, point)
            scale = self._scale(i)
            if not math.isfinite(point[0]):
                return None
            room = math.dist(point, self._entries[i]) - self.settings.hole_clearance * scale
            expected = Expected(
                point,
                last[i].direction,
                room,
                round(min(max((_SIDEWAYS + loose) * scale, 6.0), 20.0)),
                (_ALONG + loose) * scale if known else 0.0,
                last[i].contrast,
            )
            tip = None
            if known and abs(predicted.ahead) < _FOLLOW_DIRECTLY:
                on_line = dataclasses.replace(expected, search=0)
                tip = fit_expected(images[i], on_line, last[i].bright, self._detection[i])
            if tip is None:
                tip = fit_expected(images[i], expected, last[i].bright, self._detection[i])
            if tip is None:
                return None
            tips.append(tip)
            regions.append(expected)
        found = (tips[0], tips[1])
        if not (found[0].clear or found[1].clear):
            measured = Measurement(None, self.track.state, HIDDEN, found)
        else:
            measured = self._judged(found, insertion)
            if measured.tip is None and measured.reason != UNCERTAIN:
                return None
        return dataclasses.replace(measured, regions=(regions[0], regions[1]))

    def _acquire(self, images: tuple[Image, Image], insertion: float | None) -> Measurement:
        """Look everywhere that can be reached (with this insertion, where known)."""
        state = self.track.state
        paths: list[list[Path]] = []
        for i, side in enumerate(SIDES):
            paths.append(self._paths(images[i], i, insertion))
            if not paths[i]:
                return Measurement(None, state, f"no needle in the {side} image")
        paths = _of_one_polarity(paths)
        # Fitted as they are needed: the first pair is mostly the right one.
        fitted: tuple[dict[int, ImageTip | None], dict[int, ImageTip | None]] = ({}, {})
        pairs = [
            pair
            for pair in itertools.product(range(len(paths[0])), range(len(paths[1])))
            if paths[0][pair[0]].bright is paths[1][pair[1]].bright
        ]
        pairs.sort(key=lambda pair: -paths[0][pair[0]].evidence - paths[1][pair[1]].evidence)
        first: Measurement | None = None
        for pair in pairs:
            for i in range(2):
                if pair[i] not in fitted[i]:
                    path = paths[i][pair[i]]
                    sigma = 0.0 if insertion is None else _CUT * self._scale(i)
                    fitted[i][pair[i]] = fit_tip(images[i], path, self._detection[i], sigma)
            left, right = fitted[0][pair[0]], fitted[1][pair[1]]
            left_path, right_path = paths[0][pair[0]], paths[1][pair[1]]
            if left is None or right is None or not (left.clear or right.clear):
                continue
            chosen = (left_path, right_path)
            measured = self._considered(chosen, (left, right), insertion)
            if measured.tip is not None:
                return measured
            first = first or measured
        if first is not None:
            return first
        for i, side in enumerate(SIDES):
            if not any(fitted[i].values()):
                return Measurement(None, state, f"no clear tip in the {side} image")
        return Measurement(None, state, "views do not meet")

    def _considered(
        self, paths: tuple[Path, Path], found: tuple[ImageTip, ImageTip], insertion: float | None
    ) -> Measurement:
        """Judge a pair that was found without a prediction; its whole shaft counts too."""
        measured = self._judged(found, insertion)
        if measured.reason == DISAGREE_ALONG and insertion is not None and self._last:
            measured = self._one_sided(found, insertion) or measured
        sound = is_sound(measured.image_tips, _SOUND_PX, _SOUND_ALONG_PX)
        if measured.reason == TOO_FAR and sound:
            wanted = _SOUND_RIVALS
        elif (
            measured.tip is not None and not sound and not self.track.fits(measured.tip, insertion)
        ):
            if self.track.anchor is None:
                return dataclasses.replace(measured, tip=None, reason=UNCLEAR)
            wanted = _UNSOUND_RIVALS
        else:
            wanted = 0
        tip = measured.contested if measured.tip is None and wanted else measured.tip
        if tip is None:
            return measured
        problem = self._shaft_problem(paths, tip, insertion)
        if problem is not None:
            return dataclasses.replace(measured, tip=None, reason=problem)
        if not wanted:
            return measured
        if self.track.contest(tip, insertion, wanted):
            return dataclasses.replace(measured, tip=tip, contested=tip, reason="")
        return dataclasses.replace(measured, tip=None, reason=measured.reason or UNCLEAR)

    def _paths(self, image: Image, i: int, insertion: float | None) -> list[Path]:
        """Return what may be the needle in an image, as long as the insertion says."""
        look, grid = self._detection[i], self.grids[i]
        following = self._last is not None and self.track.state is TrackState.TRACKING
        if self._last is not None and following and look.bright is None:
            look = dataclasses.replace(look, bright=self._last[i].bright)
        paths = find_paths(image, grid, look, ends=self._ends(i, insertion))
        if insertion is not None:
            paths = [cut_path(path, grid, insertion) for path in paths]
        return without_shadows(distinct(paths))

    def _scale(self, i: int) -> float:
        """Return the pixels per metre of one camera."""
        return self._detection[i].needle_width_px / self.settings.needle_width

    def _shaft_problem(
        self, paths: tuple[Path, Path], tip: SpatialTip, insertion: float | None
    ) -> str | None:
        gates = self.settings.gates
        points = shaft_points(self.views, paths, tip.position)
        return shaft_problem(points, gates.reach, insertion, gates.insertion_margin)

    def _one_sided(self, found: tuple[ImageTip, ImageTip], insertion: float) -> Measurement | None:
        """Believe the one end of two that fits the track; None where none or both do."""
        left, right = found
        sides = [(left, hidden(right)), (hidden(left), right)]
        measured = [self._judged(side, insertion) for side in sides]
        fitting = [m for m in measured if m.tip is not None]
        return fitting[0] if len(fitting) == 1 else None

    def _judged(self, found: tuple[ImageTip, ImageTip], insertion: float | None) -> Measurement:
        state = self.track.state
        tip = triangulate(self.views, found)
        if tip is None:
            return Measurement(None, state, "views do not meet", found)
        refused = self.track.judge(tip, insertion)
        if refused is None:
            return Measurement(tip, state, "", found)
        return Measurement(None, state, refused, found, tip)

    def _ends(self, i: int, insertion: float | None) -> tuple[int, int] | None:
        """Return the rows of a grid in which the needle can end, None for all."""
        if insertion is None:
            return None
        gates, grid = self.settings.gates, self.grids[i]
        room = gates.insertion_margin + _GRID_MARGIN
        shortest = gates.reach.shortest_chord(insertion)
        return grid.row_of(shortest - room), grid.row_of(insertion + _GRID_AHEAD)

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


def _plain(image: Image) -> Image:
    return np.require(image, requirements=["C", "W"])


def _of_one_polarity(paths: list[list[Path]]) -> list[list[Path]]:
    """Return the dark paths of both views, or the bright ones: those that stand out more.

    Beside a dark line there are bright ones, such as the gap between needle and shadow.
    """
    best = [
        sum(max((p.evidence for p in side if p.bright is bright), default=0.0) for side in paths)
        for bright in (False, True)
    ]
    return [[path for path in side if path.bright is (best[1] > best[0])] for side in paths]
