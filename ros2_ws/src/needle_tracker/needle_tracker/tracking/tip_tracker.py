"""Two trackers for one needle: one that looks at lines, and one that looks at needle maps.

Lines are quicker and, of a plain needle, finer; they are what counts while both agree. Where lines
show no needle, or one that ends where the maps deny it, the maps count.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from needle_tracker.image.detection import Image
from needle_tracker.image.looks import MapLook
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.tracking.measurement import Measurement
from needle_tracker.tracking.track import TrackState
from needle_tracker.tracking.tracker import StereoTracker
from needle_tracker.tracking.tracker_settings import TrackerSettings
from needle_tracker.tracking.triangulation import SpatialTip

_BOTH_EVERY = 10
"""So often maps are held against lines that show a needle."""
_IN_VAIN, _RESTS = 5, 3
"""After so many looks in which maps show no needle, they are drawn of every third pair."""
_DEPTH_SIGMA = 0.8e-3
"""A tip known so badly is better than none [m]: maps know what they do not see."""
_ALIKE = 7.8
"""Squared distance over the covariance that two measurements of one tip keep in 95 of 100."""
_SHORT = 1.0
"""Standard deviations: lines that end so far before the maps' end may lack a face."""
_AGREEMENTS = 3
"""So often in a row lines agree with maps that count, to count again."""


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
        left, right = (MapLook(width) for width in self._lines.needle_widths_px)
        gates = dataclasses.replace(settings.gates, max_depth_sigma=_DEPTH_SIGMA)
        wider = dataclasses.replace(settings, gates=gates)
        self._maps = StereoTracker(calibration, wider, (left, right))
        self.settings = settings
        self._begin()

    def warm_up(self) -> None:
        """Compile, or load, all that is compiled: the first pair must not wait for it."""
        self._lines.warm_up()
        self._maps.warm_up()

    def reset(self) -> None:
        """Forget the needle."""
        self._lines.reset()
        self._maps.reset()
        self._begin()

    def _begin(self) -> None:
        self._maps_count = False
        self._agreed = 0
        self._pairs = self._in_vain = 0
        self._since_compared = _BOTH_EVERY

    def skip(self, reason: str) -> Measurement:
        """Answer a pair that cannot be looked at; it counts as one without a tip."""
        self._maps.skip(reason)
        return self._lines.skip(reason)

    def process(self, left: Image, right: Image, insertion: float | None) -> Measurement:
        """Measure the tip in a stereo pair; as `StereoTracker.process`."""
        lines = self._lines.process(left, right, insertion)
        if insertion is not None and insertion < self.settings.entry_zone:
            # A new insertion: all that is known of the last one is over.
            self._maps.process(left, right, insertion)
            self._begin()
            return lines
        self._pairs += 1
        self._since_compared += 1
        if not (self._maps_count or self._maps_are_due(lines)):
            return lines
        maps = self._maps.process(left, right, insertion)
        shown = maps.tip is not None or maps.state is TrackState.CONFIRMING
        self._in_vain = 0 if shown else self._in_vain + 1
        if lines.tip is None or maps.tip is None:
            self._agreed = 0
            self._maps_count = self._maps_count or maps.tip is not None
            return lines if maps.tip is None else maps
        self._since_compared = 0
        self._agreed = self._agreed + 1 if _agree(lines.tip, maps.tip) else 0
        self._maps_count = self._agreed < (_AGREEMENTS if self._maps_count else 1)
        return maps if self._maps_count else lines

    def _maps_are_due(self, lines: Measurement) -> bool:
        """Return whether maps are drawn of a pair although lines count."""
        if lines.tip is not None and self._since_compared < _BOTH_EVERY:
            return False
        return self._in_vain < _IN_VAIN or self._pairs % _RESTS == 0


def _agree(lines: SpatialTip, maps: SpatialTip) -> bool:
    """Return whether both can be the same end, and lines do not end short of a face."""
    between = maps.position - lines.position
    covariance = lines.covariance + maps.covariance
    ahead = maps.direction
    short = float(between @ ahead) > _SHORT * math.sqrt(float(ahead @ covariance @ ahead))
    return not short and float(between @ np.linalg.solve(covariance, between)) < _ALIKE
