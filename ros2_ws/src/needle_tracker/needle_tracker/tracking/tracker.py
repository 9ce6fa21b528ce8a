"""Stereo pair in, tip out: detection in both views, triangulation, gates, track.

The result depends on the images and insertions given so far and on nothing else: no time, no
randomness, one thread.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from needle_tracker.image.detection import DetectionSettings, Image
from needle_tracker.image.looks import LINE_LOOKS, Look
from needle_tracker.image.tip_fit import ImageTip
from needle_tracker.optics.calibration import SIDES, StereoCalibration
from needle_tracker.optics.refraction import RefractedCamera, stereo_views
from needle_tracker.tracking.acquisition import Acquisition
from needle_tracker.tracking.evidence import (
    CLEAR_ALONG_PX,
    CLEAR_PX,
    VisibilityAverage,
    has_come,
    is_sound,
)
from needle_tracker.tracking.following import (
    FOLLOW_AHEAD,
    PLAIN_ALONG_PX,
    PLAIN_PX,
    SOUND_ALONG_PX,
    SOUND_PX,
    Follower,
    HiddenEnds,
    weighed,
)
from needle_tracker.tracking.gates import tip_at_entry
from needle_tracker.tracking.measurement import Measurement, judged
from needle_tracker.tracking.refusals import NoTip, TrackState
from needle_tracker.tracking.single_view import Seen, kept_up, seen_alone
from needle_tracker.tracking.track import Track
from needle_tracker.tracking.tracker_settings import TrackerSettings
from needle_tracker.tracking.triangulation import SpatialTip

ONE_VIEW, EACH_VIEW = "one view alone", "each view by itself"
_SLOW_CHANGE = 1.06  # of the needle's contrast, from pair to pair
_CONTRADICTED = 3  # so many pairs in a row one view may contradict the other and the prediction
_LOOSE_PX = 3.0  # a line so uncertain says next to nothing
_ALONE_WAY = 5e-3  # and for so much insertion after both showed the needle well [m]
# With no end in sight, lines so good tell where the needle is, for so much more insertion [px, m].
_HIDDEN_LINE_PX, _HIDDEN_WAY = 2.0, 5e-3
_DRAWN_SHARE, _DRAWN_POINTS = 0.3, 20  # of the longest insertion, to warm up on


class StereoTracker:
    """Tracks the tip through a sequence of stereo pairs.

    Parameters
    ----------
    calibration : StereoCalibration
        The stereo rig.
    settings : TrackerSettings
        What else is known.
    looks : pair of Look, optional
        How each image is looked at; at its lines by default.
    """

    def __init__(
        self,
        calibration: StereoCalibration,
        settings: TrackerSettings,
        looks: tuple[Look, Look] = LINE_LOOKS,
    ) -> None:
        # Results must not depend on how many cores there are.
        cv2.setNumThreads(1)
        cameras = (calibration.left, calibration.right)
        self.settings = settings
        self.views = stereo_views(calibration)
        self._detection = (self._look(self.views[0]), self._look(self.views[1]))
        self._follower = Follower(
            self.views,
            self._detection,
            settings.needle_width,
            settings.hole_clearance,
            looks,
        )
        self._shapes = tuple((camera.height, camera.width) for camera in cameras)
        self.track = Track(settings.gates)
        self._usual = VisibilityAverage()
        self._acquisition = Acquisition(
            self._follower, self._detection, settings, self.track, self._usual
        )
        self._last: tuple[ImageTip, ImageTip] | None = None
        self._believed: SpatialTip | None = None
        self._contradicted = 0
        self._hidden_ends = HiddenEnds()
        self._clear_at: float | None = None
        self._sound_at: float | None = None

    @property
    def needle_widths_px(self) -> tuple[float, float]:
        """Width of the needle in the left and the right image [px]."""
        left, right = self._detection
        return left.needle_width_px, right.needle_width_px

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
        # Found, confirmed, followed.
        for _ in range(3):
            self.process(images[0], images[1], length)
        self.reset()

    def reset(self) -> None:
        """Forget the track."""
        self.track.reset()
        self._last = None
        self._believed = None
        self._contradicted = 0
        self._hidden_ends.forget()
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
                self._update_from_single_view(images, insertion)
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
        if measured is None or measured.reason == NoTip.STANDS or self.track.is_open(insertion):
            # Beside what stands still, or is not believed yet, the needle may come.
            searched = self._acquisition.look(images, insertion, self._last)
            won = searched.tip is not None and searched.contested is not None
            if measured is None or won or (measured.tip is None and searched.tip is not None):
                measured = searched
        if measured.tip is None:
            return self._missed(measured, images, insertion)
        return self._taken(measured, measured.tip, insertion)

    def _missed(
        self, measured: Measurement, images: tuple[Image, Image], insertion: float | None
    ) -> Measurement:
        """Note that both views together give no tip; return what single ones say."""
        alone = self._update_from_single_view(images, insertion)
        if measured.reason in (NoTip.HIDDEN, NoTip.UNCERTAIN):
            self.track.hide()
        elif measured.reason == NoTip.STANDS and insertion is None:
            self.track.pass_on()
        elif measured.reason == NoTip.STANDS:
            self.track.drop()
        else:
            self.track.miss()
        if self.track.anchor is None:
            self._last = None
            self._usual.forget()
        measured = dataclasses.replace(measured, state=self.track.state)
        elsewhere = measured.reason in (NoTip.TOO_FAR, NoTip.SURPRISING)
        if alone is None or elsewhere or self.track.state is not TrackState.TRACKING:
            return measured
        tip, seen = alone
        reason = f"{ONE_VIEW if None in seen else EACH_VIEW}, {measured.reason}"
        return dataclasses.replace(
            measured, tip=tip, contested=None, image_tips=seen, reason=reason
        )

    def _update_from_single_view(
        self, images: tuple[Image, Image], insertion: float | None
    ) -> tuple[SpatialTip, Seen] | None:
        """Follow with one view what both together do not show; return its tip and what it sees."""
        predicted, last = self.track.predict(insertion), self._last
        if predicted is None or last is None or not predicted.known:
            return None
        if not self.track.has_begun or abs(predicted.ahead) > FOLLOW_AHEAD:
            return None
        kept = kept_up(self._follower, images, predicted, last, self._usual)
        if kept is None:
            return None
        motion, seen = kept
        self.track.update_from_single_view(predicted, motion)
        self._last = self._steadied(seen[0] or last[0], seen[1] or last[1])
        if self._believed is None or not self.track.is_established:
            return None
        tip = seen_alone(predicted, motion, self._believed, self.settings.gates)
        return None if tip is None else (tip, seen)

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
        come = has_come(measured.image_tips)
        new = has_come(measured.image_tips, since_empty=True)
        believed = self.track.accept(
            tip, insertion, anew=anew, certain=beyond_doubt, seen=seen, come=come, new=new
        )
        self._believed = believed or self._believed
        left_tip, right_tip = measured.image_tips
        if left_tip is not None and right_tip is not None:
            self._last = (left_tip, right_tip) if anew else self._steadied(left_tip, right_tip)
            if left_tip.clear or right_tip.clear:
                self._clear_at = insertion
            if sound:
                self._sound_at = insertion
                self._usual.see((left_tip, right_tip))
        reason = NoTip.UNCONFIRMED if believed is None else ""
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
            or abs(predicted.ahead) > FOLLOW_AHEAD
            or (predicted.known and not self.track.is_certain(insertion))
        ):
            return None
        looked = self._follower.look(images, predicted, last)
        if looked is None:
            return None
        found, regions = looked
        found = self._hidden_ends.see(found)
        if not self.track.is_unbroken:
            found = self._usual.doubted(found)
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
            loose = sights is not None and any(tip.doubt_across > _LOOSE_PX for tip in sights.tips)
            alone = (contradicted or loose) and (far or not self.track.is_unbroken)
            if sights is None or alone or self._contradicted > _CONTRADICTED:
                return None
            found = sights.tips
        if not (found[0].clear or found[1].clear or self._goes_on(found, insertion)):
            measured = Measurement(None, self.track.state, NoTip.HIDDEN, found)
        else:
            measured = judged(self.views, self.track, found, insertion)
            sound = is_sound(found, SOUND_PX, SOUND_ALONG_PX)
            uncertain = measured.reason == NoTip.UNCERTAIN and self.track.is_unbroken
            stands = measured.reason == NoTip.STANDS
            if measured.tip is None and not stands and (sound or not uncertain):
                return None
        return dataclasses.replace(measured, regions=regions)

    def _goes_on(self, found: tuple[ImageTip, ImageTip], insertion: float | None) -> bool:
        """Return whether two shafts without ends are enough: the stage says how far they go."""
        if self._clear_at is None or insertion is None:
            return False
        lines = all(tip.doubt_across <= _HIDDEN_LINE_PX for tip in found)
        return lines and abs(insertion - self._clear_at) <= _HIDDEN_WAY

    def _look(self, view: RefractedCamera) -> DetectionSettings:
        settings = self.settings
        middle = np.array([0.0, 0.0, 0.5 * settings.gates.reach.length])
        facing = np.stack([view.sideways, [0.0, 0.0, 1.0]], axis=-1)
        pixels_per_metre = float(np.linalg.norm(view.jacobian(middle) @ facing, axis=0).mean())
        return DetectionSettings(
            bright=settings.bright,
            needle_width_px=settings.needle_width * pixels_per_metre,
            min_contrast=settings.min_contrast,
            noise_factor=settings.noise_factor,
        )


def _plain(image: Image) -> Image:
    return np.require(image, requirements=["C", "W"])
