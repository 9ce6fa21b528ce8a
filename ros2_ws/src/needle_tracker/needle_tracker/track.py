"""Whether a measured tip is believed: the gates, the prediction, and the track's state.

Nothing here looks at images: measured tips and insertions come in as arguments, decisions go out as
data.
"""

from __future__ import annotations

import dataclasses
import enum

import numpy as np
from numpy.typing import NDArray

from needle_tracker.gates import GateSettings, refusal
from needle_tracker.tip_motion import TipMotion
from needle_tracker.triangulation import SpatialTip

Array = NDArray[np.float64]

TOO_FAR = "too far from the last tip"
_HEADING_TOLERANCE = 0.12  # [rad]
_HIDDEN_PER_LOST = 4
_CERTAIN = 0.5e-3  # [m]
_CONFIRM_KNOWN = 2
_RIVALS_TRACKING = 2
_NO_SURPRISE = 9.0
_LARGEST_SURPRISE = 25.0  # squared, over its covariance


class TrackState(enum.Enum):
    """What the tracker knows about the needle."""

    SEARCHING = "SEARCHING"  # nothing is known: the whole reachable region is searched
    CONFIRMING = "CONFIRMING"  # something like a needle, not believed yet
    TRACKING = "TRACKING"
    LOST = "LOST"  # was tracked and is not seen; found again only where it can have got to
    ENTRY = "ENTRY"  # too short to be seen: the tip follows from the insertion


@dataclasses.dataclass(frozen=True)
class Anchor:
    """The last believed tip, or where it should be now.

    Attributes
    ----------
    motion : TipMotion
        Position and heading.
    insertion : float or None
        Of that moment [m].
    ahead : float
        How far this is ahead of the last believed tip [m].
    known : bool
        Whether that follows from the insertion.
    """

    motion: TipMotion
    insertion: float | None
    ahead: float = 0.0
    known: bool = False


class Track:
    """State of the track, advanced once per image pair.

    Parameters
    ----------
    settings : GateSettings
        The bounds.
    """

    def __init__(self, settings: GateSettings) -> None:
        self._settings = settings
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.state = TrackState.SEARCHING
        self.anchor: Anchor | None = None
        self._misses = 0
        self._hidden = 0
        self._rival: Anchor | None = None
        self._rivals = 0
        self._agreeing = 0

    def enter(self) -> None:
        """Note that the needle is in the entry zone, where it cannot be seen."""
        self.reset()
        self.state = TrackState.ENTRY

    def predict(self, insertion: float | None) -> Anchor | None:
        """Return where the tip should be now, None where there is no idea.

        Parameters
        ----------
        insertion : float or None
            Length of needle in the phantom at the exposure [m].

        Returns
        -------
        Anchor or None
            The last believed tip, moved on along its direction by the insertion since.
        """
        anchor = self.anchor
        if anchor is None:
            return None
        ahead, known = 0.0, False
        if insertion is not None and anchor.insertion is not None:
            ahead, known = insertion - anchor.insertion, True
        motion = anchor.motion.advanced(ahead, self._settings.reach.curvature)
        return Anchor(motion, insertion, ahead, known)

    def judge(self, tip: SpatialTip, insertion: float | None) -> str | None:
        """Return why a measured tip is not believed, None where it passes all gates.

        While the needle is followed, what is judged is what would be believed: the tip merged with
        its prediction. What one view says alone is then enough if the prediction says the rest.
        """
        predicted = self.predict(insertion)
        following = predicted is not None and predicted.known and self.state is TrackState.TRACKING
        merged = predicted.motion.merged(tip) if predicted is not None and following else tip
        reason = refusal(merged, insertion, self._settings)
        if reason is not None or predicted is None:
            return reason
        miss = float(np.linalg.norm(merged.position - predicted.motion.position))
        if miss > self.tolerance(predicted):
            return TOO_FAR
        if following and predicted.motion.surprise(tip) > _LARGEST_SURPRISE:
            return "too far from the prediction"
        return None

    def accept(
        self,
        tip: SpatialTip,
        insertion: float | None,
        *,
        anew: bool = False,
        certain: bool = True,
    ) -> SpatialTip | None:
        """Take a tip that passed `judge`.

        Parameters
        ----------
        tip : SpatialTip
            As measured.
        insertion : float or None
            Length of needle in the phantom at the exposure [m].
        anew : bool
            Whether what was known before was wrong.
        certain : bool
            Whether one such tip is enough to begin with, if the insertion is known.

        Returns
        -------
        SpatialTip or None
            What is believed, None where nothing is yet. While the needle is followed the tip is
            merged with its prediction, so that a view that something spoils counts less; in clear
            images it is so much better than its prediction that this hardly moves it.
        """
        predicted = self.predict(insertion)
        if self.state is not TrackState.TRACKING:
            self._agreeing = self._agreeing + 1 if self.state is TrackState.CONFIRMING else 1
            wanted = self._settings.confirm_pairs
            if insertion is not None:
                wanted = 1 if certain or self.state is TrackState.LOST else _CONFIRM_KNOWN
            confirmed = self._agreeing >= wanted
            self.state = TrackState.TRACKING if confirmed else TrackState.CONFIRMING
        self._misses = self._hidden = self._rivals = 0
        self._rival = None
        motion = TipMotion.start(tip)
        if predicted is not None and predicted.known and not anew:
            motion = predicted.motion.updated(tip)
            tip = predicted.motion.merged(tip)
        self.anchor = Anchor(motion, insertion)
        return tip if self.state is TrackState.TRACKING else None

    @property
    def is_unbroken(self) -> bool:
        """Whether the pair before had a believed tip."""
        return self._misses == 0 and self._hidden == 0

    def is_certain(self, insertion: float | None) -> bool:
        """Return whether the tip's place is known so well that half a sight of it is enough."""
        predicted = self.predict(insertion)
        if predicted is None or not predicted.known or self.state is TrackState.CONFIRMING:
            return False
        variance = float(np.linalg.eigvalsh(predicted.motion.covariance[:3, :3])[-1])
        return variance < _CERTAIN**2

    def fits(self, tip: SpatialTip, insertion: float | None) -> bool:
        """Return whether a tip is where it must be, by a prediction that is certain."""
        predicted = self.predict(insertion)
        certain = predicted is not None and self.is_certain(insertion)
        return certain and predicted is not None and predicted.motion.surprise(tip) < _NO_SURPRISE

    def contest(self, tip: SpatialTip, insertion: float | None, wanted: int) -> bool:
        """Note a tip that the track does not bear out; return whether it has won.

        Parameters
        ----------
        tip : SpatialTip
            One that passed all other gates, its whole shaft included.
        insertion : float or None
            Length of needle in the phantom at the exposure [m].
        wanted : int
            How many in a row win where the track is lost; more are wanted where it is not.

        Returns
        -------
        bool
            Whether enough such tips in a row agree: then the track was wrong.
        """
        rival = self._rival
        agrees = False
        if rival is not None and insertion is not None and rival.insertion is not None:
            ahead = insertion - rival.insertion
            motion = rival.motion.advanced(ahead, self._settings.reach.curvature)
            miss = float(np.linalg.norm(tip.position - motion.position))
            agrees = miss <= self._settings.step_margin + _HEADING_TOLERANCE * abs(ahead)
        self._rivals = self._rivals + 1 if agrees else 1
        self._rival = Anchor(TipMotion.start(tip), insertion)
        if self.state is TrackState.TRACKING:
            wanted += _RIVALS_TRACKING
        return self._rivals >= wanted

    def miss(self) -> None:
        """Note a pair without a believed tip."""
        settings = self._settings
        self._misses += 1
        if self.state is TrackState.TRACKING:
            if self._misses >= settings.lost_after:
                self.state = TrackState.LOST
        elif self.state is not TrackState.LOST:
            self.reset()
        if self.state is TrackState.LOST and self._misses >= settings.forget_after:
            self.reset()

    def hide(self) -> None:
        """Note a pair that shows the shaft where it should be, but its end in neither view."""
        self._hidden += 1
        if self._hidden > _HIDDEN_PER_LOST * self._settings.lost_after:
            self.miss()

    def tolerance(self, predicted: Anchor) -> float:
        """Return how far a tip may be from where `predict` has it [m].

        The needle goes the stage's way, bending at most by its largest curvature, and its heading
        is known to a few degrees.
        """
        settings = self._settings
        if not predicted.known:
            return settings.free_step * (self._misses + self._hidden + 1)
        ahead = abs(predicted.ahead)
        bend = 0.5 * settings.reach.curvature * ahead * ahead
        return settings.step_margin + _HEADING_TOLERANCE * ahead + bend
