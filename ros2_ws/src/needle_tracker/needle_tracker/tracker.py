"""Stereo pair in, tip out: detection in both views, triangulation, gates, track.

The result depends on the images and insertions given so far and on nothing else: no time, no
randomness, one thread.
"""

from __future__ import annotations

import dataclasses
import itertools

import cv2
import numpy as np

from needle_tracker.calibration import SIDES, StereoCalibration
from needle_tracker.corridor import within_corridor
from needle_tracker.detection import (
    DetectionSettings,
    Image,
    Path,
    cut_path,
    distinct,
    find_paths,
    without_shadows,
)
from needle_tracker.evidence import (
    CLEAR_ALONG_PX,
    CLEAR_PX,
    NEAR_ALONG_PX,
    NEAR_PX,
    UsualContrast,
    is_sound,
    sights_against,
    sights_for,
)
from needle_tracker.following import (
    PLAIN_ALONG_PX,
    PLAIN_PX,
    SOUND_ALONG_PX,
    SOUND_PX,
    Follower,
    weighed,
)
from needle_tracker.gates import DISAGREE_ALONG, UNCERTAIN, tip_at_entry
from needle_tracker.refraction import RefractedCamera
from needle_tracker.search_grid import SearchGrid, make_search_grid
from needle_tracker.shaft import shaft_points, shaft_problem
from needle_tracker.tip_fit import Expected, ImageTip, fit_tip, hidden
from needle_tracker.tip_motion import TipMotion
from needle_tracker.track import SURPRISING, TOO_FAR, Track, TrackState
from needle_tracker.tracker_settings import TrackerSettings
from needle_tracker.triangulation import SpatialTip, triangulate

UNCLEAR = "not clear enough to begin with"
HIDDEN = "the end is hidden in both images"
# A needle so short [m] is near where the entry has it, to so much of its covariance.
_YOUNG, _YOUNG_SURPRISE = 15e-3, 9.0
_SLOW_CHANGE = 1.06  # of the needle's contrast, from pair to pair
_CONTRADICTED = 3  # so many pairs in a row one view may contradict the other and the prediction
_ALONE_WAY = 5e-3  # and for so much insertion after both showed the needle well [m]
# With no end in sight, lines so good tell where the needle is, for so much more insertion [px, m].
_HIDDEN_LINE_PX, _HIDDEN_WAY = 1.0, 5e-3
_FOLLOW_AHEAD = 8e-3  # farther from the last tip, all is searched [m]
_CUT = 1.2e-3  # a path's length says so well where the needle ends (one sigma) [m]
_GRID_AHEAD = 1.5e-3
_DRAWN_SHARE, _DRAWN_POINTS = 0.3, 20  # of the longest insertion, to warm up on
_GRID_MARGIN = 3e-3  # needles off the plane x = 0 appear displaced along the grid [m]


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
        self._follower = Follower(
            self.views, self._detection, settings.needle_width, settings.hole_clearance
        )
        self._shapes = tuple((camera.height, camera.width) for camera in cameras)
        self.track = Track(settings.gates)
        self._last: tuple[ImageTip, ImageTip] | None = None
        self._contradicted = 0
        self._clear_at: float | None = None
        self._sound_at: float | None = None
        self._usual = UsualContrast()

    def warm_up(self) -> None:
        """Compile, or load, all that is compiled: the first pair must not wait for it.

        The tracker looks at a needle that it draws itself, and forgets it.
        """
        length = _DRAWN_SHARE * self.settings.gates.reach.length
        line = np.zeros((_DRAWN_POINTS, 3))
        line[:, 2] = np.linspace(0.0, length, _DRAWN_POINTS)
        needle, ground = (200, 60) if self.settings.bright else (60, 200)
        images = []
        for view, look, shape in zip(self.views, self._detection, self._shapes, strict=True):
            image = np.full(shape, ground, np.uint8)
            corners = np.round(np.nan_to_num(view.project(line))).astype(np.int32)
            cv2.polylines(image, [corners], False, needle, max(round(look.needle_width_px), 1))
            images.append(image)
        for _ in range(2):
            self.process(images[0], images[1], length)
        self.reset()

    def reset(self) -> None:
        """Forget the track."""
        self.track.reset()
        self._last = None
        self._contradicted = 0
        self._clear_at = None
        self._sound_at = None
        self._usual.forget()

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
            self._usual.forget()
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
                self._usual.forget()
            return dataclasses.replace(measured, state=self.track.state)
        return self._taken(measured, measured.tip, insertion)

    def skip(self, reason: str) -> Measurement:
        """Answer a pair that cannot be looked at; it counts as one without a tip."""
        self.track.miss()
        return Measurement(None, self.track.state, reason)

    def _taken(
        self, measured: Measurement, tip: SpatialTip, insertion: float | None
    ) -> Measurement:
        """Take a tip into the track; return it as believed."""
        anew = measured.contested is not None
        beyond_doubt = is_sound(measured.image_tips, PLAIN_PX, PLAIN_ALONG_PX)
        sound = is_sound(measured.image_tips, SOUND_PX, SOUND_ALONG_PX)
        seen = is_sound(measured.image_tips, CLEAR_PX, CLEAR_ALONG_PX)
        believed = self.track.accept(tip, insertion, anew=anew, certain=beyond_doubt, seen=seen)
        left_tip, right_tip = measured.image_tips
        if left_tip is not None and right_tip is not None:
            self._last = (left_tip, right_tip) if anew else self._steadied(left_tip, right_tip)
            if left_tip.clear or right_tip.clear:
                self._clear_at = insertion
            if sound:
                self._sound_at = insertion
                self._usual.see((left_tip, right_tip))
        reason = "not confirmed yet" if believed is None else ""
        return dataclasses.replace(measured, tip=believed, state=self.track.state, reason=reason)

    def _steadied(self, left: ImageTip, right: ImageTip) -> tuple[ImageTip, ImageTip]:
        """Return how the needle was seen last: what crosses it must not be taken for it.

        Its contrast changes slowly, and an end that is not clear has no direction of its own.
        """
        if self._last is None:
            return left, right
        first, second = (
            dataclasses.replace(
                tip,
                direction=tip.direction if tip.clear else before.direction,
                contrast=min(
                    max(tip.contrast, before.contrast / _SLOW_CHANGE),
                    before.contrast * _SLOW_CHANGE,
                ),
            )
            for tip, before in zip((left, right), self._last, strict=True)
        )
        return first, second

    def _follow(self, images: tuple[Image, Image], insertion: float | None) -> Measurement | None:
        """Look where the tip should be; None where that is not known or nothing is seen there."""
        predicted = self.track.predict(insertion)
        last = self._last
        if (
            predicted is None
            or last is None
            or abs(predicted.ahead) > _FOLLOW_AHEAD
            or (predicted.known and not self.track.is_certain(insertion))
        ):
            return None
        looked = self._follower.look(images, predicted, last)
        if looked is None:
            return None
        found, regions = looked
        if predicted.known:
            sights = weighed(self.views, found, predicted.motion)
            contradicted = sights is not None and sights.contradicted
            self._contradicted = self._contradicted + 1 if contradicted else 0
            # One view alone bridges what passes; it does not take up a track that has gaps.
            # And it does so for a while only after both showed the needle well.
            far = (
                self._sound_at is None
                or insertion is None
                or abs(insertion - self._sound_at) > _ALONE_WAY
            )
            alone = contradicted and (far or not self.track.is_unbroken)
            if sights is None or alone or self._contradicted > _CONTRADICTED:
                return None
            found = sights.tips
        if not (found[0].clear or found[1].clear or self._goes_on(found, insertion)):
            measured = Measurement(None, self.track.state, HIDDEN, found)
        else:
            measured = self._judged(found, insertion)
            sound = is_sound(found, SOUND_PX, SOUND_ALONG_PX)
            if measured.tip is None and (sound or measured.reason != UNCERTAIN):
                return None
        return dataclasses.replace(measured, regions=regions)

    def _goes_on(self, found: tuple[ImageTip, ImageTip], insertion: float | None) -> bool:
        """Return whether two shafts without ends are enough: the stage says how far they go."""
        if self._clear_at is None or insertion is None:
            return False
        lines = all(tip.sigma_across <= _HIDDEN_LINE_PX for tip in found)
        return lines and abs(insertion - self._clear_at) <= _HIDDEN_WAY

    def _acquire(self, images: tuple[Image, Image], insertion: float | None) -> Measurement:
        """Look along the way that the needle has gone, then everywhere that can be reached."""
        way = self.track.way(insertion)
        if way is not None:
            left, right = (
                within_corridor(grid, view, *way)
                for grid, view in zip(self.grids, self.views, strict=True)
            )
            measured = self._search(images, insertion, (left, right), on_way=True)
            if measured.tip is not None or self.track.is_established:
                return measured
        return self._search(images, insertion, self.grids)

    def _search(
        self,
        images: tuple[Image, Image],
        insertion: float | None,
        grids: tuple[SearchGrid, SearchGrid],
        *,
        on_way: bool = False,
    ) -> Measurement:
        """Look for the needle in the grids (as long as this insertion, where known)."""
        state = self.track.state
        paths: list[list[Path]] = []
        for i, side in enumerate(SIDES):
            paths.append(self._paths(images[i], i, grids[i], insertion))
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
            measured = self._considered(chosen, (left, right), insertion, on_way=on_way)
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
        self,
        paths: tuple[Path, Path],
        found: tuple[ImageTip, ImageTip],
        insertion: float | None,
        *,
        on_way: bool,
    ) -> Measurement:
        """Judge a pair that was found without a prediction; its whole shaft counts too."""
        measured = self._judged(found, insertion)
        if measured.reason == DISAGREE_ALONG and insertion is not None and self._last:
            measured = self._one_sided(found, insertion) or measured
        wanted = self._sights_wanted(measured, found, insertion, on_way=on_way)
        if wanted is None:
            return dataclasses.replace(measured, tip=None, reason=measured.reason or UNCLEAR)
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

    def _sights_wanted(
        self,
        measured: Measurement,
        found: tuple[ImageTip, ImageTip],
        insertion: float | None,
        *,
        on_way: bool,
    ) -> int | None:
        """Return how many such tips in a row must agree, 0 where one will do, None for never."""
        track, tip = self.track, measured.tip or measured.contested
        if tip is not None and track.is_excluded(tip, insertion):
            return None
        alike = self._usual.is_like(found)
        if measured.tip is None:
            refused = measured.reason in (TOO_FAR, SURPRISING, UNCERTAIN)
            return sights_against(track.state, found, alike=alike, on_way=on_way) if refused else 0
        if track.fits(measured.tip, insertion, on_way=False):
            return 0
        near = on_way and track.fits(measured.tip, insertion, on_way=True)
        if self._is_young(measured, insertion) and not track.has_begun:
            return 0
        return sights_for(track.state, measured.image_tips, alike=alike, near=near)

    def _is_young(self, measured: Measurement, insertion: float | None) -> bool:
        """Return whether a short needle is seen about where the entry has it.

        There it is enough to see it less well: nothing else begins at the entry, and a needle that
        waits for its first tip to be found never gets to where it is seen better.
        """
        if insertion is None or insertion > _YOUNG or measured.tip is None:
            return False
        if not is_sound(measured.image_tips, NEAR_PX, NEAR_ALONG_PX):
            return False
        reach = self.settings.gates.reach
        entry = tip_at_entry(insertion, reach.hole_tolerance, reach.entry_angle)
        return TipMotion.start(entry).surprise(measured.tip) < _YOUNG_SURPRISE

    def _paths(self, image: Image, i: int, grid: SearchGrid, insertion: float | None) -> list[Path]:
        """Return what may be the needle in an image, as long as the insertion says."""
        look = self._detection[i]
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
