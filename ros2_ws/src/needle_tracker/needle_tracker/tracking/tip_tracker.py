"""Two trackers for one needle: one that looks at lines, and one that looks at needle maps.

Lines are quicker and, of a plain needle, finer; they are what counts while both agree. Where lines
show no needle, or one that ends where the maps deny it, the maps count; and where what shines may
be a lamp that the needle mirrors. Neither claims more than it can know.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from needle_tracker.image.backgrounds import Backgrounds
from needle_tracker.image.detection import Image
from needle_tracker.image.looks import CLEAR_WIDTHS, MapLook
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.tracking.claims import OF_LAMP, OF_MAP, OF_OUTLINE, Claims, StagedEnd
from needle_tracker.tracking.measurement import Measurement
from needle_tracker.tracking.refusals import NoTip, TrackState, progress
from needle_tracker.tracking.tracker import StereoTracker
from needle_tracker.tracking.tracker_settings import TrackerSettings
from needle_tracker.tracking.triangulation import SpatialTip

_BOTH_EVERY = 10
"""So often maps are held against lines that show a needle."""
_IN_VAIN, _RESTS = 5, 3
"""After so many looks in which maps show no needle, they are drawn of every third pair."""
_APART_WIDTHS = 2.0
"""So far along the needle may two views see a bevel end."""
_ALIKE = 7.8
"""Squared distance over the covariance that two measurements of one tip keep in 95 of 100."""
_IN_A_ROW = 3
"""So often in a row maps confirm lines that did not count, or deny lines they have confirmed."""


@dataclasses.dataclass(frozen=True)
class _Pair:
    """A pair whose maps are drawn: images, insertion [m], what lines show and whether of a lamp."""

    left: Image
    right: Image
    insertion: float | None
    lines: Measurement
    mirrored: bool


class TipTracker:
    """Tracks the tip through a sequence of stereo pairs.

    Parameters
    ----------
    calibration : StereoCalibration
        The stereo rig.
    settings : TrackerSettings
        What else is known.
    """

    def __init__(self, calibration: StereoCalibration, settings: TrackerSettings) -> None:
        self._lines = StereoTracker(calibration, settings)
        widths = self._lines.needle_widths_px
        self._claims = Claims(
            self._lines.views, widths, settings.needle_width, settings.bevel_length
        )
        gates = settings.gates
        self._staged = StagedEnd(0.5 * gates.reach.hole_tolerance, gates.insertion_margin)
        face_widths = settings.bevel_length / settings.needle_width
        left, right, *earlier = (MapLook(each, face_widths * each) for each in (*widths, *widths))
        self._looks, self._earlier = (left, right), earlier
        known = (self._lines.views, settings.hole_clearance, settings.needle_width)
        self._backgrounds = Backgrounds(*known, settings.reference)
        self._recording = Backgrounds(*known, None)
        if settings.reference is not None:
            # It may be of another day, and tells nothing of what has come in this recording.
            left.earlier, right.earlier = self._earlier
        # A tip that is known badly is better than none: maps know what they do not see.
        wider = dataclasses.replace(
            gates,
            max_depth_sigma=CLEAR_WIDTHS * settings.needle_width,
            max_disagreement=max(gates.max_disagreement, _APART_WIDTHS * settings.needle_width),
        )
        of_maps = dataclasses.replace(settings, gates=wider)
        self._maps = StereoTracker(calibration, of_maps, (left, right))
        self.settings = settings
        self._begin()

    def warm_up(self) -> None:
        """Compile, or load, all that is compiled: the first pair must not wait for it."""
        self._lines.warm_up()
        self._maps.warm_up()

    def reset(self) -> None:
        """Forget the needle, not what stands behind it."""
        self._lines.reset()
        self._maps.reset()
        self._begin()

    def _begin(self) -> None:
        self._staged.forget()
        self._maps_count = self._have_agreed = False
        self._against = 0
        self._put_off: _Pair | None = None
        self._said = "no needle"
        self._pairs = self._in_vain = 0
        self._since_compared = _BOTH_EVERY

    def skip(self, reason: str) -> Measurement:
        """Answer a pair that cannot be looked at; it counts as one without a tip."""
        self.catch_up()
        self._maps.skip(reason)
        return self._lines.skip(reason)

    def process(self, left: Image, right: Image, insertion: float | None) -> Measurement:
        """Measure the tip in a stereo pair; as `StereoTracker.process`."""
        self.catch_up()
        lines = self._lines.process(left, right, insertion)
        behind = self._backgrounds.see((left, right), insertion)
        self._looks[0].background, self._looks[1].background = behind
        earlier = self._recording.see((left, right), insertion)
        self._earlier[0].background, self._earlier[1].background = earlier
        if insertion is not None and insertion < self.settings.entry_zone:
            # A new insertion: all that is known of the last one is over.
            self._maps.process(left, right, insertion)
            self._begin()
            return lines
        mirrored = self._may_be_a_lamp(lines)
        if lines.tip is not None:
            unseen = OF_LAMP if mirrored else OF_OUTLINE
            lines = dataclasses.replace(lines, tip=self._claims.widened(lines.tip, unseen))
        self._pairs += 1
        self._since_compared += 1
        if not (self._maps_count or self._maps_are_due(lines)):
            # What maps said last still holds while they rest.
            told = lines.tip is None and progress(self._said) > progress(lines.reason)
            return dataclasses.replace(lines, reason=self._said) if told else lines
        pair = _Pair(left, right, insertion, lines, mirrored)
        if self._lines_count_anyhow(lines):
            self._put_off = pair
            return lines
        return self._compare(pair)

    def catch_up(self) -> None:
        """Draw the maps that the last answer did not wait for; the next pair does it otherwise."""
        put_off, self._put_off = self._put_off, None
        if put_off is not None:
            self._compare(put_off)

    def _lines_count_anyhow(self, lines: Measurement) -> bool:
        """Return whether lines are the answer, whatever maps show in this pair."""
        tried = self._have_agreed and self._against + 1 < _IN_A_ROW
        return lines.tip is not None and tried and not self._maps_count

    def _compare(self, pair: _Pair) -> Measurement:
        """Draw a pair's maps and hold them against its lines; return what counts."""
        lines, insertion = pair.lines, pair.insertion
        maps = self._maps.process(pair.left, pair.right, insertion)
        if maps.tip is not None:
            tip = self._claims.widened(maps.tip, OF_MAP)
            maps = dataclasses.replace(maps, tip=self._staged.placed(tip, maps.shaft, insertion))
        self._said = "no needle" if maps.tip is not None else maps.reason
        stands = maps.reason == NoTip.STANDS
        shown = maps.tip is not None or (maps.state is TrackState.CONFIRMING and not stands)
        self._in_vain = 0 if shown else self._in_vain + 1
        instead = lines.tip is None and maps.tip is not None
        # What one view alone shows, and says so, denies nothing that both show.
        if lines.tip is None or maps.tip is None or (maps.reason and not pair.mirrored):
            self._against = 0
            self._maps_count = self._maps_count or instead
            farther = lines.tip is None and progress(maps.reason) > progress(lines.reason)
            return maps if instead or farther else lines
        self._since_compared = 0
        self._hear(agree=not pair.mirrored and _agree(lines.tip, maps.tip))
        return maps if self._maps_count else lines

    def _may_be_a_lamp(self, lines: Measurement) -> bool:
        """Return whether lines are brighter than the floor though nobody said the needle is."""
        if self.settings.bright:
            return False
        return any(tip is not None and tip.bright for tip in lines.image_tips)

    def _hear(self, *, agree: bool) -> None:
        """Note whether maps confirm the lines: decide which count."""
        self._against = self._against + 1 if agree is self._maps_count else 0
        untried = not (self._maps_count or self._have_agreed)
        if self._against >= (1 if untried else _IN_A_ROW):
            self._maps_count = not agree
            self._against = 0
        self._have_agreed = self._have_agreed or agree

    def _maps_are_due(self, lines: Measurement) -> bool:
        """Return whether maps are drawn of a pair although lines count."""
        if lines.tip is not None and not self._against and self._since_compared < _BOTH_EVERY:
            return False
        return self._in_vain < _IN_VAIN or self._pairs % _RESTS == 0


def _agree(lines: SpatialTip, maps: SpatialTip) -> bool:
    """Return whether both can be the same end."""
    between = maps.position - lines.position
    return float(between @ np.linalg.solve(lines.covariance + maps.covariance, between)) < _ALIKE
