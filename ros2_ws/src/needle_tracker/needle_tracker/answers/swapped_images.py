"""Whether left and right images seem to be swapped, as when the cameras are plugged the wrong way.

Swapped images show the needle well, but in places that do not fit together: nothing is found. Only
then, and for a share of the pairs, a second tracker looks at them the other way round. What it says
is a suspicion, and no tip.
"""

from __future__ import annotations

from needle_tracker.filter.background import Image
from needle_tracker.filter.measurement import Measurement, TrackState
from needle_tracker.filter.needle_tracker import NeedleTracker
from needle_tracker.filter.settings import TrackerSettings
from needle_tracker.optics.calibration import StereoCalibration

SUSPICION = "left and right images seem to be swapped: the other way round they show a needle"
# Pairs without a tip before the first look, pairs looked at in a row, and how often that is done.
_BEFORE, _LOOKS, _PERIOD = 5, 10, 20
# So many pairs in a row must show a needle the other way round.
_AGREEING = 4


class SwapWatch:
    """Suspects swapped images from what a tracker finds in them, and another in the reverse.

    Parameters
    ----------
    calibration : StereoCalibration
        The stereo rig.
    settings : TrackerSettings
        The tracker's settings.

    Attributes
    ----------
    suspected : bool
        Whether the last pairs show a needle only the other way round; until a tip is found.
    """

    def __init__(self, calibration: StereoCalibration, settings: TrackerSettings) -> None:
        left, right = calibration.left, calibration.right
        # Of different sizes, swapped images are refused by their size.
        self._can_look = (left.height, left.width) == (right.height, right.width)
        self._calibration = calibration
        self._settings = settings
        self._other: NeedleTracker | None = None
        self._missed = 0
        self._agreeing = 0
        self.suspected = False

    def see(
        self, left: Image, right: Image, insertion: float | None, measured: Measurement
    ) -> None:
        """Take a pair and what was measured in it; look at it the other way round if need be.

        Parameters
        ----------
        left, right : ndarray of uint8, shape (height, width)
            As they were given to the tracker.
        insertion : float or None
            Likewise [m].
        measured : Measurement
            What the tracker said.
        """
        if measured.state is TrackState.ENTRY:
            return
        if measured.tip is not None:
            self._missed = self._agreeing = 0
            self.suspected = False
            return
        turn = (self._missed - _BEFORE) % _PERIOD
        looks = self._can_look and self._missed >= _BEFORE and turn < _LOOKS
        self._missed += 1
        if self.suspected or not looks:
            return
        if self._other is None:
            self._other = NeedleTracker(self._calibration, self._settings)
        if turn == 0:
            self._other.reset()
            self._agreeing = 0
        other = self._other.process(right, left, insertion)
        self._agreeing = self._agreeing + 1 if other.tip is not None else 0
        self.suspected = self._agreeing >= _AGREEING
