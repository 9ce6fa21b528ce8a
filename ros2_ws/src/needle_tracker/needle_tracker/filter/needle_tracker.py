"""Tracker of the needle's tip: a stereo pair in, the accepted tip out.

Tracks are looked for where they are expected; if that fails, both images are searched. The result
depends only on the images and insertions so far: no time, no randomness, one thread.
"""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_tracker.detector.end_fit import FIT, ImageEnd
from needle_tracker.detector.needle_detector import DETECTOR, NeedleDetector
from needle_tracker.detector.needle_net import NeedleNet
from needle_tracker.filter.measurement import Measurement, NoTip, TrackState
from needle_tracker.filter.needle_track import HEADING, NeedleTrack, tip_at_entry
from needle_tracker.filter.settings import FILTER
from needle_tracker.optics.calibration import SIDES, StereoCalibration
from needle_tracker.optics.refraction import stereo_views
from needle_tracker.stereo.sighting import PAIRING, Ends, Sighting, StereoSearch, evidence
from needle_tracker.stereo.triangulation import SpatialTip, triangulate
from needle_tracker.tracker_parameters import StereoTrackerParameters

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Pair = tuple[Image, Image]
"""Left and right image."""


@dataclasses.dataclass(frozen=True)
class FollowingSettings:
    """Constants of the tracker outside its filter.

    Attributes
    ----------
    tracks : int
        Largest number of tracks.
    least_gate_px : float
        Least half size of the window in which an end is expected [px].
    least_new_widths : float
        Growth of the needle since a pair at which that pair becomes the background [needle widths].
    glance_shrink : int
        Factor by which a view is shrunk for comparison with the previous one.
    change : float
        Least relative change in the brightness of most of a view: more than flicker, less than a
        lamp.
    dark : int
        Brightest grey level of a black image.
    """

    tracks: int = 4
    least_gate_px: float = 4.0
    least_new_widths: float = 3.0
    glance_shrink: int = 32
    change: float = 0.2
    dark: int = 10


FOLLOWING = FollowingSettings()


class Background:
    """The pair with the least needle so far: by insertion or, if unknown, the first one.

    Parameters
    ----------
    reference : pair of ndarray of uint8, shape (height, width), or None
        Initial background: left and right image of the phantom without needle.
    least_new : float
        Growth of the needle since a pair at which that pair becomes the background [m].
    """

    def __init__(self, reference: Pair | None, least_new: float) -> None:
        self._pair: Pair | None = None
        self._insertion: float | None = None
        self._least_new = least_new
        if reference is not None:
            self.update(reference, 0.0)

    def update(self, pair: Pair, insertion: float | None) -> Pair | None:
        """Process a pair and its insertion [m], if known; return its background, if any."""
        before = math.inf if self._insertion is None else self._insertion
        less = insertion is not None and insertion <= max(before, 0.0)
        if self._pair is None or less:
            self._insertion = insertion
            # The driver of a camera may reuse the array.
            self._pair = pair[0].copy(), pair[1].copy()
            return None
        if insertion is not None and insertion - before < self._least_new:
            return None
        return self._pair


class NeedleTracker:
    """Tracker of the tip through a sequence of stereo pairs.

    Parameters
    ----------
    calibration : StereoCalibration
        The stereo rig.
    settings : StereoTrackerParameters
        Needle and stage.
    reference : pair of ndarray of uint8, shape (height, width), or None
        Left and right image of the phantom without needle.
    """

    def __init__(
        self,
        calibration: StereoCalibration,
        settings: StereoTrackerParameters,
        reference: Pair | None = None,
    ) -> None:
        # Results must not depend on the number of cores.
        cv2.setNumThreads(1)
        self.settings = settings
        self.views = stereo_views(calibration)
        self._shapes = tuple((c.height, c.width) for c in (calibration.left, calibration.right))
        net = NeedleNet()
        left, right = (NeedleDetector(view, settings, net) for view in self.views)
        self._detectors = (left, right)
        self._search = StereoSearch(self.views, self._detectors, settings)
        self._background = self._new_background(reference)
        self._views_before: tuple[Array, ...] | None = None
        self._current_background: Pair | None = None
        self.reset()

    @property
    def needle_widths_px(self) -> tuple[float, float]:
        """Width of the needle in the left and the right image [px]."""
        left, right = self._detectors
        return left.width_px, right.width_px

    def warm_up(self) -> None:
        """Compile or load all compiled functions, so that the first pair is not delayed.

        The tracker processes a synthetic needle, then forgets it.
        """
        background, self._background = self._background, self._new_background(None)
        length = 2.0 * DETECTOR.full_size_reach
        line = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, length]])
        images = []
        for view, width, shape in zip(self.views, self.needle_widths_px, self._shapes, strict=True):
            image = np.full(shape, 200, np.uint8)
            corners = np.round(np.nan_to_num(view.project(line))).astype(np.int32)
            cv2.polylines(image, [corners], False, 0, max(round(width), 1))
            images.append(image)
        # The needle is found in the first pair, and followed in the second one.
        for _ in range(2):
            self.process(images[0], images[1], length)
        self.reset()
        self._background, self._views_before = background, None
        self._use_background(None)

    def reset(self) -> None:
        """Forget the needle, but keep the background."""
        self._tracks: list[NeedleTrack] = []
        self._believed = False

    def skip(self, reason: str) -> Measurement:
        """Return the measurement of a pair that cannot be processed: a miss of all tracks."""
        self._tracks = [track.missed() for track in self._tracks]
        return self._answer(None, reason)

    def process(self, left: Image, right: Image, insertion: float | None) -> Measurement:
        """Measure the tip in a stereo pair.

        Parameters
        ----------
        left, right : ndarray of uint8, shape (height, width)
            Images of one exposure, of the calibration's size.
        insertion : float or None
            Length of needle beyond the entry point at the exposure [m]; None if unknown.

        Returns
        -------
        Measurement
            Result, with or without a tip.

        Raises
        ------
        ValueError
            The size of an image differs from the calibration.
        """
        pair = np.ascontiguousarray(left), np.ascontiguousarray(right)
        self._check(pair)
        for side, image in zip(SIDES, pair, strict=True):
            if int(image[::8, ::8].max()) < FOLLOWING.dark:
                return self.skip(f"{side} image is black")
        measured = self._measure(pair, insertion)
        if measured.tip is None and insertion is not None and insertion < self.settings.entry_zone:
            tip = tip_at_entry(insertion, self.settings)
            return dataclasses.replace(measured, tip=tip, state=TrackState.ENTRY, reason="")
        return measured

    def _measure(self, pair: Pair, insertion: float | None) -> Measurement:
        """Measure the tip in the images."""
        changed = self._view_changed(pair)
        if changed:
            self._background = self._new_background(None)
        background = self._background.update(pair, insertion)
        if background is not self._current_background:
            self._use_background(background)
        if insertion is not None and insertion < self.settings.hole_clearance:
            self.reset()
            return self._answer(None, NoTip.NOTHING)
        for detector, image in zip(self._detectors, pair, strict=True):
            detector.set_image(image)
        settings = self.settings
        self._tracks = [track.predicted(insertion, settings) for track in self._tracks]
        best = self._best() if self._believed else None
        sighting = None if best is None else self._follow(best)
        if best is not None and sighting is not None:
            predicted, followed = self._tracks, best.updated(sighting, settings)
            self._tracks = [followed if t is best else t.missed() for t in predicted]
            if self._probability(followed) > FILTER.accepted:
                return self._answer(sighting, "")
            self._tracks = predicted
        if changed:
            # A lamp was switched or a camera was bumped: most new lines are not the needle.
            self._tracks = [track.missed() for track in self._tracks]
            return self._answer(None, NoTip.CHANGED)
        found, ends = self._search_images(insertion)
        return self._answer(found, "", ends)

    def _view_changed(self, pair: Pair) -> bool:
        """Return whether the brightness of most of a view changed since the previous pair."""
        before, scale = self._views_before, 4.0 / FOLLOWING.glance_shrink
        # Every fourth row and column suffices for the mean, and is read much faster.
        thinned = [np.ascontiguousarray(image[::4, ::4]) for image in pair]
        self._views_before = tuple(
            cv2.resize(image, None, None, scale, scale, cv2.INTER_AREA).astype(np.float64)
            for image in thinned
        )
        return before is not None and any(
            float(np.median(np.abs(now - then))) > FOLLOWING.change * float(np.median(then))
            for now, then in zip(self._views_before, before, strict=True)
        )

    def _search_images(self, insertion: float | None) -> tuple[Sighting | None, Ends]:
        """Search both images; return the best sighting and the best end of each view."""
        settings = self.settings
        least, most = settings.hole_clearance, settings.max_insertion
        if insertion is not None:
            margin = PAIRING.sigmas * math.hypot(
                settings.stage_zero_sigma, settings.stage_scale_sigma * insertion
            )
            least = max(least, settings.shortest_chord(insertion) - margin)
            most = min(most, insertion + margin)
        left, ends = self._search.search(least, most)
        tracks: list[tuple[NeedleTrack, Sighting | None]] = []
        for track in sorted(self._tracks, key=lambda t: -t.rank()):
            own = min(left, key=lambda s: track.surprise(s.tip, settings), default=None)
            if own is None or not track.fits(own.tip, settings):
                tracks.append((track.missed(), None))
            else:
                left.remove(own)
                tracks.append((track.updated(own, settings), own))
        tracks += [(NeedleTrack.begin(each, insertion, settings), each) for each in left]
        kept = [pair for pair in tracks if pair[0].misses < FILTER.forgotten_after]
        kept.sort(key=lambda pair: -pair[0].rank())
        self._tracks = [track for track, _ in kept[: FOLLOWING.tracks]]
        return kept[0][1] if kept else None, ends

    def _follow(self, track: NeedleTrack) -> Sighting | None:
        """Return the sighting of a track at its predicted tip; None if the fit fails."""
        position, covariance = track.tip
        if float(np.linalg.eigvalsh(covariance)[-1]) > (2.0 * FILTER.free_step) ** 2:
            return None
        heading = track.motion.mean[HEADING]
        ends = []
        for view, detector in zip(self.views, self._detectors, strict=True):
            point, jacobian = view.project(position), view.jacobian(position)
            ahead = jacobian @ heading
            direction = ahead / np.linalg.norm(ahead)
            spread = jacobian @ covariance @ jacobian.T
            across = np.array([-direction[1], direction[0]])
            end = detector.fit(
                point,
                direction,
                along=FOLLOWING.least_gate_px
                + PAIRING.sigmas * math.sqrt(direction @ spread @ direction),
                across=FOLLOWING.least_gate_px
                + PAIRING.sigmas * math.sqrt(across @ spread @ across),
            )
            if end is None:
                return None
            ends.append(end)
        pair: tuple[ImageEnd, ImageEnd] = (ends[0], ends[1])
        tip = triangulate(self.views, pair, position)
        if tip is None:
            return None
        surprise = track.surprise(tip, self.settings)
        if surprise >= PAIRING.gate:
            return None
        sighting = Sighting(tip, pair, evidence(pair, tip))
        # Ends that both views show where the insertion predicts them need less evidence.
        is_predicted = surprise < PAIRING.sigmas**2
        are_visible = min(end.ends for end in pair) > FIT.hidden_end
        needed = -track.length_log_odds if is_predicted and are_visible else 0.0
        return sighting if sighting.evidence > needed else None

    def _answer(
        self, sighting: Sighting | None, reason: str, ends: Ends = (None, None)
    ) -> Measurement:
        best = self._best()
        if best is None:
            self._believed = False
            return Measurement(None, TrackState.SEARCHING, reason or NoTip.NOTHING, ends)
        probability = self._probability(best)
        accepted = probability > FILTER.accepted
        self._believed = accepted or (self._believed and best.log_odds() > 0.0)
        state = TrackState.TRACKING if self._believed else TrackState.CONFIRMING
        if self._believed and best.misses >= FILTER.lost_after:
            state = TrackState.LOST
        if sighting is not None:
            ends = sighting.ends
        tip: SpatialTip | None = None
        if sighting is None:
            reason = reason or NoTip.NOTHING
        elif not accepted:
            reason = NoTip.UNCONFIRMED
        else:
            tip = self._published(sighting.tip)
            reason = NoTip.UNCERTAIN if tip is None else ""
        return Measurement(tip, state, reason, ends, probability, best.stage)

    def _published(self, tip: SpatialTip) -> SpatialTip | None:
        """Return the tip to be published of an accepted needle; None if it is too uncertain.

        Errors from the bevel, its lighting or a shadow beside the shaft persist from pair to pair:
        they cancel in displacements, and averaging pairs would not reduce them. The direction is
        that of a straight line, from which the end of a bent needle differs.
        """
        if float(np.linalg.eigvalsh(tip.covariance)[-1]) > FILTER.max_sigma**2:
            return None
        settings = self.settings
        along = np.outer(tip.direction, tip.direction)
        hidden = FILTER.end_sigma * settings.needle_width
        # Half the line's length times the curvature, which is uniform up to the largest one.
        turn = settings.max_curvature * FIT.line_widths * settings.needle_width / math.sqrt(12.0)
        return dataclasses.replace(
            tip,
            covariance=tip.covariance + hidden**2 * along,
            direction_covariance=tip.direction_covariance + turn**2 * (np.eye(3) - along),
        )

    def _best(self) -> NeedleTrack | None:
        return max(self._tracks, key=lambda track: track.rank(), default=None)

    def _probability(self, track: NeedleTrack) -> float:
        """Return the probability that a track, and no other, is the needle."""
        odds = [math.exp(each.rank()) for each in self._tracks]
        return math.exp(track.rank()) / (1.0 + sum(odds))

    def _new_background(self, reference: Pair | None) -> Background:
        return Background(reference, FOLLOWING.least_new_widths * self.settings.needle_width)

    def _use_background(self, pair: Pair | None) -> None:
        self._current_background = pair
        for detector, image in zip(self._detectors, pair or (None, None), strict=True):
            detector.set_background(image)

    def _check(self, pair: Pair) -> None:
        for side, image, shape in zip(SIDES, pair, self._shapes, strict=True):
            if image.shape != shape or image.dtype != np.uint8:
                raise ValueError(
                    f"{side} image is {image.dtype}{image.shape}, expected uint8{shape}"
                )
