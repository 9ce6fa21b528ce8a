"""Stereo pair in, tip out: look where tracks are expected, search where they are not, believe one.

The answer depends on the images and insertions given so far and on nothing else: no time, no
randomness, one thread.
"""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.detector.needle_detector import NeedleDetector
from needle_tracker.detector.needle_net import NeedleNet
from needle_tracker.filter.background import Background, Image, Pair
from needle_tracker.filter.measurement import Measurement, NoTip, TrackState
from needle_tracker.filter.needle_motion import HEADING
from needle_tracker.filter.needle_track import NeedleTrack
from needle_tracker.filter.settings import TrackerSettings
from needle_tracker.optics.calibration import SIDES, StereoCalibration
from needle_tracker.optics.refraction import stereo_views
from needle_tracker.stereo.sighting import SIGMAS, Ends, Sighting, StereoSearch, evidence
from needle_tracker.stereo.triangulation import SpatialTip, triangulate

Array = NDArray[np.float64]

_TRACKS = 4  # things followed at once
_LEAST_GATE_PX = 4.0  # half the size of the window that an end is looked for in
_MOST_FOLLOWED = 8e-3  # an end known worse than that is searched for [m]
_LEAST_NEW_WIDTHS = 3.0  # of needle, since a background that is of use [needle widths]
_GLANCE = (32, 24)  # size that views are compared at from pair to pair [px]
_CHANGE = 0.2  # of most of a view's brightness: more than flicker, less than a lamp
_DRAWN_LENGTH, _DRAWN_POINTS = 0.04, 20  # of the needle to warm up on [m]
_DARK = 10  # brightest grey level of an image that shows nothing


class NeedleTracker:
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
        self.settings = settings
        self.views = stereo_views(calibration)
        self._shapes = tuple((c.height, c.width) for c in (calibration.left, calibration.right))
        net = NeedleNet()
        left, right = (
            NeedleDetector(
                view, settings.needle_width, settings.reach, settings.hole_clearance, net
            )
            for view in self.views
        )
        self._detectors = (left, right)
        self._search = StereoSearch(
            self.views, self._detectors, settings.reach, settings.windows, settings.tip_lean
        )
        self._least_new = _LEAST_NEW_WIDTHS * settings.needle_width
        self._background = Background(settings.reference, self._least_new)
        self._views_before: tuple[Array, ...] | None = None
        self._shown: Pair | None = None
        self.reset()

    @property
    def needle_widths_px(self) -> tuple[float, float]:
        """Width of the needle in the left and the right image [px]."""
        left, right = self._detectors
        return left.width_px, right.width_px

    def warm_up(self) -> None:
        """Compile, or load, all that is compiled: the first pair must not wait for it.

        The tracker looks at a needle that it draws itself, and forgets it.
        """
        background = self._background
        self._background = Background(None, self._least_new)
        line = np.zeros((_DRAWN_POINTS, 3))
        line[:, 2] = np.linspace(0.0, _DRAWN_LENGTH, _DRAWN_POINTS)
        images = []
        for view, width, shape in zip(self.views, self.needle_widths_px, self._shapes, strict=True):
            image = np.full(shape, 200, np.uint8)
            corners = np.round(np.nan_to_num(view.project(line))).astype(np.int32)
            cv2.polylines(image, [corners], False, 60, max(round(width), 1))
            images.append(image)
        # Found, then followed.
        for _ in range(2):
            self.process(images[0], images[1], _DRAWN_LENGTH)
        self.reset()
        self._background, self._views_before = background, None
        self._use_background(None)

    def reset(self) -> None:
        """Forget the needle, not what stands behind it."""
        self._tracks: list[NeedleTrack] = []
        self._believed = False

    def skip(self, reason: str) -> Measurement:
        """Answer a pair that cannot be looked at; it counts as one without a tip."""
        self._tracks = [track.missed() for track in self._tracks]
        return self._answer(None, reason)

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
        pair = np.ascontiguousarray(left), np.ascontiguousarray(right)
        self._check(pair)
        for side, image in zip(SIDES, pair, strict=True):
            if int(image[::8, ::8].max()) < _DARK:
                return self.skip(f"{side} image is black")
        measured = self._measure(pair, insertion)
        if measured.tip is None and insertion is not None and insertion < self.settings.entry_zone:
            tip = tip_at_entry(insertion, self.settings)
            return dataclasses.replace(measured, tip=tip, state=TrackState.ENTRY, reason="")
        return measured

    def _measure(self, pair: Pair, insertion: float | None) -> Measurement:
        """Measure the tip as the images show it."""
        changed = self._view_changed(pair)
        if changed:
            # What stands behind the needle is no longer known.
            self._background = Background(None, self._least_new)
        background = self._background.see(pair, insertion)
        if background is not self._shown:
            self._use_background(background)
        if insertion is not None and insertion < self.settings.hole_clearance:
            self.reset()
            return self._answer(None, NoTip.NOTHING)
        for detector, image in zip(self._detectors, pair, strict=True):
            detector.see(image)
        settings = self.settings
        self._tracks = [track.predicted(insertion, settings) for track in self._tracks]
        best = self._best()
        sighting = None
        if best is not None and self._believed:
            sighting = self._follow(best)
        if sighting is not None and best is not None:
            predicted, followed = self._tracks, best.seen(sighting, settings)
            self._tracks = [followed if t is best else t.missed() for t in predicted]
            if self._probability(followed) > settings.filter.accepted:
                return self._answer(sighting, "")
            self._tracks = predicted
        if changed:
            # A lamp was switched or a camera bumped: much is new, and little of it the needle.
            self._tracks = [track.missed() for track in self._tracks]
            return self._answer(None, NoTip.CHANGED)
        found, ends = self._look_everywhere(insertion)
        return self._answer(found, "", ends)

    def _view_changed(self, pair: Pair) -> bool:
        """Return whether most of a view differs from the last pair's by more than its light."""
        before = self._views_before
        self._views_before = tuple(
            cv2.resize(image, _GLANCE, interpolation=cv2.INTER_AREA).astype(np.float64)
            for image in pair
        )
        return before is not None and any(
            float(np.median(np.abs(now - then))) > _CHANGE * float(np.median(then))
            for now, then in zip(self._views_before, before, strict=True)
        )

    def _look_everywhere(self, insertion: float | None) -> tuple[Sighting | None, Ends]:
        """Search both images; return the best track's sighting, and what each view shows alone."""
        settings = self.settings
        least, most = settings.hole_clearance, settings.reach.length
        if insertion is not None:
            margin = SIGMAS * math.hypot(
                settings.stage_zero_sigma, settings.stage_scale_sigma * insertion
            )
            least = max(least, settings.reach.shortest_chord(insertion) - margin)
            most = min(most, insertion + margin)
        left, ends = self._search.search(least, most)
        tracks: list[tuple[NeedleTrack, Sighting | None]] = []
        for track in sorted(self._tracks, key=lambda t: -t.rank(settings)):
            own = min(left, key=lambda s: track.surprise(s.tip, settings), default=None)
            if own is None or not track.fits(own.tip, settings):
                tracks.append((track.missed(), None))
            else:
                left.remove(own)
                tracks.append((track.seen(own, settings), own))
        tracks += [(NeedleTrack.begin(each, insertion, settings), each) for each in left]
        kept = [pair for pair in tracks if pair[0].misses < settings.filter.forgotten_after]
        kept.sort(key=lambda pair: -pair[0].rank(settings))
        self._tracks = [track for track, _ in kept[:_TRACKS]]
        return kept[0][1] if kept else None, ends

    def _follow(self, track: NeedleTrack) -> Sighting | None:
        """Look for the end where a track has it."""
        position, covariance = track.tip
        if float(np.linalg.eigvalsh(covariance)[-1]) > _MOST_FOLLOWED**2:
            return None
        heading = track.motion.mean[HEADING]
        ends = []
        for view, detector in zip(self.views, self._detectors, strict=True):
            point, jacobian = view.project(position), view.jacobian(position)
            ahead = jacobian @ heading
            direction = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
            spread = jacobian @ covariance @ jacobian.T
            across = np.array([-direction[1], direction[0]])
            end = detector.fit(
                point,
                direction,
                along=_LEAST_GATE_PX + SIGMAS * math.sqrt(direction @ spread @ direction),
                across=_LEAST_GATE_PX + SIGMAS * math.sqrt(across @ spread @ across),
            )
            if end is None:
                return None
            ends.append(end)
        pair: tuple[ImageEnd, ImageEnd] = (ends[0], ends[1])
        tip = triangulate(self.views, pair)
        if tip is None or not track.fits(tip, self.settings):
            return None
        sighting = Sighting(tip, pair, evidence(pair, tip))
        return sighting if sighting.evidence > 0.0 else None

    def _answer(
        self, sighting: Sighting | None, reason: str, ends: Ends = (None, None)
    ) -> Measurement:
        best = self._best()
        if best is None:
            self._believed = False
            return Measurement(None, TrackState.SEARCHING, reason or NoTip.NOTHING, ends)
        numbers = self.settings.filter
        probability = self._probability(best)
        accepted = probability > numbers.accepted
        self._believed = accepted or (self._believed and best.log_odds > 0.0)
        state = TrackState.TRACKING if self._believed else TrackState.CONFIRMING
        if self._believed and best.misses >= numbers.lost_after:
            state = TrackState.LOST
        if sighting is not None:
            ends = sighting.ends
        tip: SpatialTip | None = None
        if sighting is None:
            reason = reason or NoTip.NOTHING
        elif not accepted:
            reason = NoTip.UNCONFIRMED
        else:
            tip = self._told(sighting.tip)
            reason = NoTip.UNCERTAIN if tip is None else ""
        return Measurement(tip, state, reason, ends, probability, best.stage)

    def _told(self, tip: SpatialTip) -> SpatialTip | None:
        """Return what is told of a believed needle, None if these two views leave it open.

        What a bevel and its light hide, and a shadow beside the shaft, last from pair to pair: they
        cancel in motion, and pairs are not merged, since nothing averages out.
        """
        numbers = self.settings.filter
        if float(np.linalg.eigvalsh(tip.covariance)[-1]) > numbers.max_sigma**2:
            return None
        hidden = numbers.end_sigma * self.settings.needle_width * tip.direction
        return dataclasses.replace(tip, covariance=tip.covariance + np.outer(hidden, hidden))

    def _best(self) -> NeedleTrack | None:
        return max(self._tracks, key=lambda track: track.rank(self.settings), default=None)

    def _probability(self, track: NeedleTrack) -> float:
        """Return the probability that a track, and no other, is the needle."""
        odds = [math.exp(each.rank(self.settings)) for each in self._tracks]
        return math.exp(track.rank(self.settings)) / (1.0 + sum(odds))

    def _use_background(self, pair: Pair | None) -> None:
        self._shown = pair
        for detector, image in zip(self._detectors, pair or (None, None), strict=True):
            detector.set_background(image)

    def _check(self, pair: Pair) -> None:
        for side, image, shape in zip(SIDES, pair, self._shapes, strict=True):
            if image.shape != shape or image.dtype != np.uint8:
                raise ValueError(f"{side} image is {image.dtype}{image.shape}, wants uint8{shape}")


def tip_at_entry(insertion: float, settings: TrackerSettings) -> SpatialTip:
    """Return the tip of a short needle that is not seen: on the z axis of `rig`."""
    reach = settings.reach
    sideways = math.hypot(reach.hole_tolerance, insertion * math.sin(reach.entry_angle))
    along = math.hypot(reach.hole_tolerance, insertion * (1.0 - math.cos(reach.entry_angle)))
    return SpatialTip(
        np.array([0.0, 0.0, insertion]),
        np.diag([sideways**2, sideways**2, along**2]),
        np.array([0.0, 0.0, 1.0]),
        np.diag([reach.entry_angle**2, reach.entry_angle**2, 0.0]),
    )
