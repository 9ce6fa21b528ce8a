"""Find the needle where no prediction says where its end must be, and judge what is found.

First along the way that the needle has gone, then everywhere that it can reach. What is found so
must be seen better, or more often, than what is followed; the whole shaft counts.
"""

from __future__ import annotations

import dataclasses
import itertools

from needle_tracker.image.corridor import within_corridor
from needle_tracker.image.detection import (
    DetectionSettings,
    Image,
    Path,
    cut_path,
    distinct,
    of_one_polarity,
    without_shadows,
)
from needle_tracker.image.search_grid import SearchGrid, make_search_grid
from needle_tracker.image.shaft import shaft_points, shaft_problem
from needle_tracker.image.tip_fit import ImageTip, fit_tip, hidden
from needle_tracker.optics.calibration import SIDES
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking.evidence import (
    VisibilityAverage,
    has_come,
    is_half_sound,
    is_sound,
    look_alike,
    shows_lines,
    sights_to_confirm,
    sights_to_contradict,
    sights_to_exclude,
)
from needle_tracker.tracking.following import FOLLOW_AHEAD, SOUND_ALONG_PX, SOUND_PX, Follower
from needle_tracker.tracking.guided_search import guided_pairs, leads, predicted_from_entry
from needle_tracker.tracking.measurement import Measurement, judged
from needle_tracker.tracking.refusals import NoTip, TrackState
from needle_tracker.tracking.tip_prediction import Anchor
from needle_tracker.tracking.track import Track
from needle_tracker.tracking.tracker_settings import TrackerSettings
from needle_tracker.tracking.triangulation import SpatialTip

Last = tuple[ImageTip, ImageTip]
# A needle so short [m] is near where the entry has it, to so much of its covariance; and so near if
# that is to say which of two ends is the needle's.
_ENTRY_REGION, _ENTRY_SURPRISE, _ENTRY_NEAR = 15e-3, 9.0, 2.0
_FROM_ENTRY = 25e-3  # up to here the entry says about where the end is [m]
_FITTING = 9.0  # squared, over the covariance: place and direction of what one view guides to
_AGREE = 1e-3  # two views that say the same do so along the needle, too [m]
_CUT = 1.2e-3  # a path's length says so well where the needle ends (one sigma) [m]
# Needles off the grid's plane appear displaced along it [m].
_GRID_AHEAD, _GRID_MARGIN = 1.5e-3, 3e-3


class Acquisition:
    """Searches both images for the needle.

    Parameters
    ----------
    follower : Follower
        Fits the needle's end in either view.
    detection : pair of DetectionSettings
        How the needle looks in each.
    settings : TrackerSettings
        What else is known.
    track : Track
        What is known of the needle; contested tips are noted there.
    usual : VisibilityAverage
        How much it stands out.
    """

    def __init__(
        self,
        follower: Follower,
        detection: tuple[DetectionSettings, DetectionSettings],
        settings: TrackerSettings,
        track: Track,
        usual: VisibilityAverage,
    ) -> None:
        self._follower = follower
        self._views = follower.views
        self._detection = detection
        self._settings = settings
        self._track = track
        self._usual = usual
        self._grids = (self._grid(self._views[0]), self._grid(self._views[1]))

    def look(
        self, images: tuple[Image, Image], insertion: float | None, last: Last | None
    ) -> Measurement:
        """Look along the way that the needle has gone, then everywhere that can be reached.

        Parameters
        ----------
        images : pair of ndarray of uint8
            Left and right.
        insertion : float or None
            Length of needle in the phantom at the exposure [m].
        last : pair of ImageTip or None
            How the needle was seen last.
        """
        way = self._track.way(insertion)
        if way is not None:
            left, right = (
                within_corridor(grid, view, *way)
                for grid, view in zip(self._grids, self._views, strict=True)
            )
            measured = self._search(images, insertion, last, (left, right), on_way=True)
            predicted = self._track.predict(insertion)
            if measured.tip is None and predicted is not None and last is not None:
                measured = (
                    self._where_expected(images, insertion, predicted, last)
                    or self._guided(images, insertion, measured.image_tips, predicted, last)
                    or measured
                )
            if measured.tip is not None or self._track.is_established:
                return measured
        measured = self._search(images, insertion, last, self._grids)
        if measured.tip is None and insertion is not None and insertion < _FROM_ENTRY:
            predicted = predicted_from_entry(self._settings.gates.reach, insertion)
            guided = self._guided(images, insertion, measured.image_tips, predicted, None)
            measured = guided or measured
        return measured

    def _where_expected(
        self, images: tuple[Image, Image], insertion: float | None, predicted: Anchor, last: Last
    ) -> Measurement | None:
        """Look just where the tip should be, though that is not known well."""
        if abs(predicted.ahead) > FOLLOW_AHEAD:
            return None
        looked = self._follower.look(images, predicted, last)
        if looked is None:
            return None
        found, regions = self._usual.unmixed(looked[0]), looked[1]
        measured = judged(self._views, self._track, found, insertion)
        if measured.tip is None or not (found[0].clear or found[1].clear):
            return None
        if not self._is_borne_out(measured.tip, found, insertion, on_way=True):
            return None
        return dataclasses.replace(measured, regions=regions)

    def _guided(
        self,
        images: tuple[Image, Image],
        insertion: float | None,
        seen: tuple[ImageTip | None, ImageTip | None],
        predicted: Anchor,
        last: Last | None,
    ) -> Measurement | None:
        """Look in each view where the end is that the other shows."""
        left, right = (
            tip if tip is not None and self._usual.is_like_in(i, tip) else None
            for i, tip in enumerate(seen)
        )
        best: tuple[Measurement, Last] | None = None
        least = _FITTING
        for pair in guided_pairs(self._follower, images, predicted, (left, right), last):
            found = self._usual.unmixed(pair)
            if not (is_half_sound(found) and self._usual.allows(found)):
                continue
            measured = judged(self._views, self._track, found, insertion)
            tip = measured.tip or measured.contested
            if tip is None or tip.disagreement > _AGREE:
                continue
            surprise = predicted.motion.surprise(tip)
            if surprise < least and predicted.motion.direction_surprise(tip) < _FITTING:
                best, least = (measured, found), surprise
        if best is None:
            return None
        wanted = self._sights_wanted(*best, insertion, on_way=True, guided=True)
        decided = None if wanted is None else self._decided(best[0], insertion, wanted)
        return None if decided is None or decided.tip is None else decided

    def _search(
        self,
        images: tuple[Image, Image],
        insertion: float | None,
        last: Last | None,
        grids: tuple[SearchGrid, SearchGrid],
        *,
        on_way: bool = False,
    ) -> Measurement:
        """Look for the needle in the grids (as long as this insertion, where known)."""
        state = self._track.state
        paths: list[list[Path]] = []
        for i, side in enumerate(SIDES):
            paths.append(self._paths(images[i], i, grids[i], insertion, last))
            if not paths[i]:
                return Measurement(None, state, f"no needle in the {side} image")
        paths = of_one_polarity(paths)
        # Fitted as they are needed: the first pair is mostly the right one.
        fitted: tuple[dict[int, ImageTip | None], dict[int, ImageTip | None]] = ({}, {})
        pairs = [
            pair
            for pair in itertools.product(range(len(paths[0])), range(len(paths[1])))
            if paths[0][pair[0]].bright is paths[1][pair[1]].bright
        ]
        pairs.sort(key=lambda pair: -paths[0][pair[0]].evidence - paths[1][pair[1]].evidence)
        best: Measurement | None = None
        first: Measurement | None = None
        for pair in pairs:
            for i in range(2):
                if pair[i] not in fitted[i]:
                    path = paths[i][pair[i]]
                    sigma = 0.0 if insertion is None else _CUT * self._scale(i)
                    fitted[i][pair[i]] = fit_tip(
                        images[i], path, self._detection[i], sigma, self._follower.looks[i].fit
                    )
            left, right = fitted[0][pair[0]], fitted[1][pair[1]]
            left_path, right_path = paths[0][pair[0]], paths[1][pair[1]]
            if left is None or right is None or not (left.clear or right.clear):
                continue
            measured = self._considered(
                (left_path, right_path), (left, right), insertion, last, on_way=on_way
            )
            if measured.tip is not None:
                if measured.contested is not None or not self._track.is_open(insertion):
                    return measured
                # It may stand still for good: what else may be the needle is noted, too.
                best = best or measured
            first = first or measured
        best = best or first
        if best is not None:
            return best
        # Where something crosses the needle in one view, the other's end may lead to it.
        alone = tuple(max(filter(None, tips.values()), key=leads, default=None) for tips in fitted)
        reason: str = NoTip.NO_COMMON_POINT
        if None in alone:
            reason = f"no clear tip in the {SIDES[alone.index(None)]} image"
        return Measurement(None, state, reason, (alone[0], alone[1]))

    def _considered(
        self,
        paths: tuple[Path, Path],
        found: tuple[ImageTip, ImageTip],
        insertion: float | None,
        last: Last | None,
        *,
        on_way: bool,
    ) -> Measurement:
        """Judge a pair that was found without a prediction; its whole shaft counts too."""
        if on_way:
            found = self._usual.unmixed(found)
        measured = judged(self._views, self._track, found, insertion)
        if measured.reason == NoTip.DISAGREE_ALONG and insertion is not None:
            measured = self._one_sided(found, insertion, last) or measured
        wanted = self._sights_wanted(measured, found, insertion, on_way=on_way)
        if wanted is None:
            return dataclasses.replace(measured, tip=None, reason=measured.reason or NoTip.UNCLEAR)
        tip = measured.contested if measured.tip is None and wanted else measured.tip
        if tip is None:
            return measured
        # How long a short shaft is, its coarse path hardly says; its ends do.
        plain = not wanted and is_sound(found, SOUND_PX, SOUND_ALONG_PX)
        young = plain and self._begins_at_entry(measured, insertion)
        gates = self._settings.gates
        shaft = shaft_points(self._views, paths, tip.position)
        problem = shaft_problem(
            shaft, gates.reach, None if young else insertion, gates.insertion_margin
        )
        if problem is not None:
            return dataclasses.replace(measured, tip=None, reason=problem)
        return self._decided(dataclasses.replace(measured, shaft=shaft), insertion, wanted)

    def _decided(self, measured: Measurement, insertion: float | None, wanted: int) -> Measurement:
        """Return what is measured, believed if no more sights are wanted or it has had them."""
        tip = measured.tip or measured.contested
        if not wanted or tip is None:
            return measured
        come = has_come(measured.image_tips)
        if self._track.contest(tip, insertion, wanted, come=come):
            return dataclasses.replace(measured, tip=tip, contested=tip, reason="")
        return dataclasses.replace(measured, tip=None, reason=measured.reason or NoTip.UNCLEAR)

    def _sights_wanted(
        self,
        measured: Measurement,
        found: tuple[ImageTip, ImageTip],
        insertion: float | None,
        *,
        on_way: bool,
        guided: bool = False,
    ) -> int | None:
        """Return how many such tips in a row must agree, 0 where one will do, None for never."""
        track, tip = self._track, measured.tip or measured.contested
        alike = self._usual.is_like(found)
        if tip is not None and track.is_excluded(tip, insertion):
            return sights_to_exclude(track.state, found, alike=alike)
        come = insertion is None
        if measured.tip is None:
            if measured.reason not in (NoTip.TOO_FAR, NoTip.SURPRISING, NoTip.UNCERTAIN):
                return 0
            come = come and measured.reason == NoTip.TOO_FAR
            return sights_to_contradict(track.state, found, alike=alike, on_way=on_way, come=come)
        if (
            track.fits(measured.tip, insertion, on_way=False)
            or self._is_borne_out(measured.tip, found, insertion, on_way=on_way)
            or self._begins_at_entry(measured, insertion)
        ):
            return 0
        near = on_way and track.fits(measured.tip, insertion, on_way=True)
        return sights_to_confirm(
            track.state,
            measured.image_tips,
            alike=alike,
            possible=self._usual.allows(found),
            near=near,
            guided=guided,
            come=(come and has_come(found))
            or (not track.has_begun and has_come(found, since_empty=True)),
        )

    def _is_borne_out(
        self, tip: SpatialTip, found: Last, insertion: float | None, *, on_way: bool
    ) -> bool:
        """Return whether a tip, seen well or not, is just where it is waited for."""
        track = self._track
        if not shows_lines(found) or tip.disagreement > _AGREE:
            return False
        if track.state is TrackState.CONFIRMING:
            return track.fits(tip, insertion, on_way=True)
        return on_way and track.expects(tip, insertion) and self._usual.allows(found)

    def _begins_at_entry(self, measured: Measurement, insertion: float | None) -> bool:
        """Return whether a short needle is first seen about where the entry has it.

        There it is enough to see it less well: nothing else begins at the entry, and a needle that
        waits for its first tip to be found never gets to where it is seen better.
        """
        tip = measured.tip
        if self._track.has_begun or insertion is None or insertion > _ENTRY_REGION or tip is None:
            return False
        left, right = measured.image_tips
        if left is None or right is None:
            return False
        if not (shows_lines((left, right)) and look_alike(left, right)):
            return False
        return self._entry_surprise(tip, insertion) < _ENTRY_SURPRISE

    def _entry_surprise(self, tip: SpatialTip, insertion: float) -> float:
        """Return how far a tip is from where the entry has it, squared, over the covariance."""
        predicted = predicted_from_entry(self._settings.gates.reach, insertion)
        return predicted.motion.surprise(tip)

    def _one_sided(
        self, found: tuple[ImageTip, ImageTip], insertion: float, last: Last | None
    ) -> Measurement | None:
        """Believe the one end of two that fits what is known, the more so where both do.

        None where neither does, or both and nothing says which.
        """
        left, right = found
        fitting: list[tuple[SpatialTip, Measurement]] = []
        for side in ((left, hidden(right)), (hidden(left), right)):
            measured = judged(self._views, self._track, side, insertion)
            tip = measured.tip
            if tip is not None and (last is not None or self._is_near_entry(tip, insertion)):
                fitting.append((tip, measured))
        if len(fitting) > 1:
            fitting = [each for each in fitting if self._track.expects(each[0], insertion)]
            fitting.sort(key=lambda each: self._track.surprise(each[0], insertion))
        return fitting[0][1] if fitting else None

    def _is_near_entry(self, tip: SpatialTip, insertion: float) -> bool:
        return insertion <= _ENTRY_REGION and self._entry_surprise(tip, insertion) < _ENTRY_NEAR

    def _paths(
        self, image: Image, i: int, grid: SearchGrid, insertion: float | None, last: Last | None
    ) -> list[Path]:
        """Return what may be the needle in an image, as long as the insertion says."""
        look = self._detection[i]
        following = last is not None and self._track.state is TrackState.TRACKING
        if last is not None and following and look.bright is None:
            look = dataclasses.replace(look, bright=last[i].bright)
        paths = self._follower.looks[i].find_paths(image, grid, look, self._ends(i, insertion))
        if insertion is not None:
            paths = [cut_path(path, grid, insertion) for path in paths]
        return without_shadows(distinct(paths))

    def _scale(self, i: int) -> float:
        """Return the pixels per metre of one camera."""
        return self._detection[i].needle_width_px / self._settings.needle_width

    def _ends(self, i: int, insertion: float | None) -> tuple[int, int] | None:
        """Return the rows of a grid in which the needle can end, None for all."""
        if insertion is None:
            return None
        gates, grid = self._settings.gates, self._grids[i]
        room = gates.insertion_margin + _GRID_MARGIN
        shortest = gates.reach.shortest_chord(insertion)
        return grid.row_of(shortest - room), grid.row_of(insertion + _GRID_AHEAD)

    def _grid(self, view: RefractedCamera) -> SearchGrid:
        settings = self._settings
        return make_search_grid(view, settings.gates.reach, first_distance=settings.hole_clearance)
