"""Whether a measured tip is believed: the gates, the prediction, and the track's state.

Nothing here looks at images: measured tips and insertions come in as arguments, decisions go out as
data.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from needle_tracker.tracking.gates import GateSettings, refusal
from needle_tracker.tracking.refusals import NoTip, TrackState
from needle_tracker.tracking.tip_prediction import Anchor, SeenEnds, Sights, TipMotion
from needle_tracker.tracking.triangulation import SpatialTip

Array = NDArray[np.float64]

_HEADING_TOLERANCE = 0.12  # [rad]
_HIDDEN_PER_LOST = 4
_CERTAIN = 0.5e-3  # [m]
# A needle that both views showed so often lies where it was seen; that is not soon forgotten.
_ESTABLISHED, _PATIENCE = 10, 5
_SURE = 2  # both views must have shown its end so often, or once beyond doubt, to be sure of it
_NEAR_ENTRY = 10e-3  # up to here the entry says where it is [m]
_PITCH = 0.5e-3  # of the places that the tip has passed [m]
# The shaft may lie so far beside them: a pre-bend, an error, tissue that gives [m].
_BESIDE = 2.0e-3
_CONFIRM_KNOWN = 2
_CONFIRM_MISSES = 2  # so many pairs may lie between
_EXPECTED, _NO_SURPRISE = 4.0, 9.0  # squared, over its covariance
_NEAR, _FAR = 2e-3, 3e-3  # from the prediction [m]
_WORST_PREDICTION = 1.5e-3  # what is known worse bears nothing out (one sigma) [m]
_LARGEST_SURPRISE = 25.0  # squared, over its covariance


class Track:
    """State of the track, advanced once per image pair.

    Parameters
    ----------
    settings : GateSettings
        The bounds.
    """

    def __init__(self, settings: GateSettings) -> None:
        self._settings = settings
        self._curvature = settings.reach.curvature
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        # Pairs of a recording in which an end may be believed that only the empty phantom lacks.
        self._unproven = self._settings.confirm_pairs
        self._ends = SeenEnds()
        self.drop()

    def drop(self) -> None:
        """Forget the needle, not where ends were seen in this recording."""
        self.state = TrackState.SEARCHING
        self.anchor: Anchor | None = None
        self._misses = 0
        self._hidden = 0
        self._rival: Sights | None = None
        self._next_rival: Sights | None = None
        self._agreeing: Sights | None = None
        self._sights = 0
        self._is_sure = False
        self._passed: list[tuple[float, Array]] = []

    def enter(self) -> None:
        """Note that the needle is in the entry zone, where it cannot be seen."""
        self.reset()
        self.state = TrackState.ENTRY

    def predict(self, insertion: float | None) -> Anchor | None:
        """Return where the tip should be now, None where there is no idea.

        It is the last believed tip, moved along its direction by the insertion [m] since then.
        """
        anchor = self.anchor
        if anchor is None:
            return None
        ahead, known = 0.0, False
        if insertion is not None and anchor.insertion is not None:
            ahead, known = insertion - anchor.insertion, True
        motion = anchor.motion.advanced(ahead, self._curvature, anchor.unseen)
        return Anchor(motion, insertion, ahead, known, anchor.unseen + abs(ahead))

    def update_from_single_view(self, predicted: Anchor, motion: TipMotion) -> None:
        """Take what one view alone says of a needle that is not believed for the moment.

        Parameters
        ----------
        predicted : Anchor
            From `predict`.
        motion : TipMotion
            The same with that taken in.
        """
        self.anchor = Anchor(motion, predicted.insertion, unseen=predicted.unseen)

    def judge(self, tip: SpatialTip, insertion: float | None) -> str | None:
        """Return why a measured tip is not believed, None where it passes all gates.

        While the needle is followed, what is judged is what would be believed: the tip merged with
        its prediction. What one view says alone is then enough if the prediction says the rest.
        """
        predicted = self.predict(insertion)
        following = predicted is not None and predicted.known and self.state is TrackState.TRACKING
        merged = predicted.motion.merged(tip) if predicted is not None and following else tip
        reason = refusal(merged, insertion, self._settings)
        if reason == NoTip.UNCERTAIN and refusal(tip, insertion, self._settings) is None:
            # Only the two together are: they contradict each other.
            merged, reason = tip, NoTip.SURPRISING
        if predicted is None or reason not in (None, NoTip.SURPRISING):
            return reason
        off = merged.position - predicted.motion.position
        way = float(off @ predicted.motion.heading)
        beside = float(np.linalg.norm(off - way * predicted.motion.heading))
        # Without the insertion nobody knows how far it goes, but it goes its heading's way.
        astray = not predicted.known and beside > self._room(way)
        if astray or float(np.linalg.norm(off)) > self.tolerance(predicted):
            return NoTip.TOO_FAR
        if following and predicted.motion.surprise(tip) > _LARGEST_SURPRISE:
            return NoTip.SURPRISING
        return reason

    def accept(
        self,
        tip: SpatialTip,
        insertion: float | None,
        *,
        anew: bool = False,
        certain: bool = True,
        seen: bool = True,
        come: bool = False,
        new: bool = False,
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
        seen : bool
            Whether both views show the end.
        come : bool
            Whether they show it where nothing was before: one such tip is enough, too.
        new : bool
            Whether they show it where nothing was in the empty phantom. Without the insertion it is
            believed for `confirm_pairs` pairs; then it must have moved: it may be an old track.

        Returns
        -------
        SpatialTip or None
            What is believed, None where nothing is yet. While the needle is followed the tip is
            merged with its prediction, so that a view that something spoils counts less; in clear
            images it is so much better than its prediction that this hardly moves it.
        """
        predicted, seen_at = self.predict(insertion), tip.position
        if self.state is not TrackState.TRACKING:
            agreeing = self._seen_again(tip, insertion, self._next_rival if anew else None)
            wanted = 1 if come else self._settings.confirm_pairs
            if insertion is not None:
                wanted = 1 if certain or self.state is TrackState.LOST else _CONFIRM_KNOWN
            told = insertion is not None or come or agreeing.has_moved(tip, self._curvature)
            confirmed = told and agreeing.count >= wanted
            self.state = TrackState.TRACKING if confirmed else TrackState.CONFIRMING
            self._agreeing = agreeing
        self._misses = self._hidden = 0
        believed = self.state is TrackState.TRACKING
        if believed:
            self._rival = self._next_rival = None
            self._unproven = 0
        else:
            self.pass_on()
            believed = new and insertion is None and self._unproven > 0
            self._unproven -= believed
        if anew and (predicted is None or not self._is_on_way(tip, predicted)):
            self._sights, self._is_sure, self._passed = 0, False, []
        self._sights += seen
        self._is_sure = self._is_sure or certain or self._sights >= _SURE
        motion = TipMotion.start(tip)
        if predicted is not None and predicted.known and not anew:
            motion = predicted.motion.updated(tip)
            tip = predicted.motion.merged(tip)
        self.anchor = Anchor(motion, insertion)
        if insertion is not None:
            self._passed = [p for p in self._passed if p[0] < insertion - _PITCH]
            self._passed.append((insertion, motion.position))
            self._ends.add(seen_at, insertion)
        return tip if believed else None

    def _seen_again(self, tip: SpatialTip, insertion: float | None, rival: Sights | None) -> Sights:
        """Return the sights that agree, with one more."""
        agreeing = self._first_sight(tip, insertion)
        before = self._agreeing if self.state is TrackState.CONFIRMING else None
        if before and (insertion is not None or before.lead_to(tip, self._curvature)):
            agreeing = before.one_more(agreeing.last)
        # What has won has been seen in agreement with itself before.
        return agreeing if rival is None or rival.count < agreeing.count else rival

    def _first_sight(self, tip: SpatialTip, insertion: float | None) -> Sights:
        last = self.anchor if self.has_begun else None
        stands = last is not None and last.motion.surprise(tip) < _NO_SURPRISE
        seen = Anchor(TipMotion.start(tip), insertion)
        return Sights(None if stands else seen.motion, seen)

    def stands(self, tip: SpatialTip, insertion: float | None = None) -> bool:
        """Return whether a tip is that of a thing that was seen often enough and has not moved.

        With the insertion that is an end that did not go with the needle. Without, nothing tells an
        old track, a scratch or a screw from a needle at rest.
        """
        if insertion is not None:
            return self._ends.is_still(tip.position, insertion)
        agreeing = self._agreeing
        if self.state is not TrackState.CONFIRMING or agreeing is None:
            return False
        often = agreeing.count >= self._settings.confirm_pairs
        same = agreeing.lead_to(tip, self._curvature)
        return often and same and not agreeing.has_moved(tip, self._curvature)

    def _is_on_way(self, tip: SpatialTip, predicted: Anchor) -> bool:
        miss = float(np.linalg.norm(tip.position - predicted.motion.position))
        return miss <= max(self.tolerance(predicted), _BESIDE)

    @property
    def has_begun(self) -> bool:
        """Whether there was a believed tip."""
        return self.state in (TrackState.TRACKING, TrackState.LOST)

    def is_open(self, insertion: float | None) -> bool:
        """Return whether whatever moves may be the needle: none is believed, nor told of."""
        return insertion is None and not self.has_begun

    @property
    def is_established(self) -> bool:
        """Whether the needle was seen well so often that it cannot be elsewhere."""
        return self.anchor is not None and self._sights >= _ESTABLISHED

    @property
    def is_unbroken(self) -> bool:
        """Whether the pair before had a believed tip."""
        return self._misses == 0 and self._hidden == 0

    def way(self, insertion: float | None) -> tuple[Array, Array] | None:
        """Return where the needle passes, as far as its tip was seen on its way.

        Parameters
        ----------
        insertion : float or None
            Length of needle in the phantom at the exposure [m].

        Returns
        -------
        points : ndarray, shape (n, 3)
            Outwards, the predicted tip last, in `rig` [m].
        half_widths : ndarray, shape (n,)
            How far beside them the needle may be [m].
        """
        predicted = self.predict(insertion)
        if predicted is None or not predicted.known or self.state is TrackState.CONFIRMING:
            return None
        assert insertion is not None
        passed = [position for length, position in self._passed if length < insertion - _PITCH]
        points = np.array([*passed, predicted.motion.position])
        half_widths = np.full(len(points), _BESIDE)
        half_widths[-1] = max(self.tolerance(predicted), _BESIDE)
        return points, half_widths

    def is_certain(self, insertion: float | None) -> bool:
        """Return whether the tip's place is known so well that half a sight of it is enough."""
        predicted = self.predict(insertion)
        if predicted is None or not predicted.known or self.state is TrackState.CONFIRMING:
            return False
        assert insertion is not None
        if not self._is_sure and insertion > _NEAR_ENTRY:
            return False
        return predicted.motion.sigma < _CERTAIN

    def fits(self, tip: SpatialTip, insertion: float | None, *, on_way: bool) -> bool:
        """Return whether a tip is where it must be, by a prediction that is certain."""
        if not (on_way or self.is_certain(insertion)):
            return False
        predicted = self.predict(insertion)
        return predicted is not None and predicted.is_about(tip, _NEAR, _NO_SURPRISE, _NO_SURPRISE)

    def expects(self, tip: SpatialTip, insertion: float | None) -> bool:
        """Return whether a tip is where it is most likely, and that is known about."""
        predicted = self.predict(insertion)
        if predicted is None or predicted.motion.sigma > _WORST_PREDICTION:
            return False
        return predicted.is_about(tip, _FAR, _EXPECTED, _NO_SURPRISE)

    def surprise(self, tip: SpatialTip, insertion: float | None) -> float:
        """Return how far a tip is from its prediction, squared, over the covariance of both."""
        predicted = self.predict(insertion)
        return math.inf if predicted is None else predicted.motion.surprise(tip)

    def is_excluded(self, tip: SpatialTip, insertion: float | None) -> bool:
        """Return whether a needle that was seen so well before cannot have got to a tip."""
        predicted = self.predict(insertion)
        if predicted is None or not predicted.known or not self.is_established:
            return False
        miss = float(np.linalg.norm(tip.position - predicted.motion.position))
        return miss > _FAR and predicted.motion.surprise(tip) > _NO_SURPRISE

    def contest(
        self, tip: SpatialTip, insertion: float | None, wanted: int, *, come: bool = False
    ) -> bool:
        """Note a tip that the track does not bear out; return whether it has won.

        Parameters
        ----------
        tip : SpatialTip
            One that passed all other gates, its whole shaft included.
        insertion : float or None
            Length of needle in the phantom at the exposure [m].
        wanted : int
            How many in a row win.
        come : bool
            Whether both views show an end where nothing was before.

        Returns
        -------
        bool
            Whether enough such tips in a row agree: then the track was wrong.
        """
        sights = self._first_sight(tip, insertion)
        if (rival := self._rival) is not None:
            ahead, allowed = 0.0, self._settings.free_step
            if insertion is not None and rival.last.insertion is not None:
                ahead = insertion - rival.last.insertion
                allowed = self._settings.step_margin + _HEADING_TOLERANCE * abs(ahead)
            motion = rival.last.motion.advanced(ahead, self._curvature)
            if float(np.linalg.norm(tip.position - motion.position)) <= allowed:
                sights = rival.one_more(sights.last)
        # Of what one pair shows several may agree with the pair before: that is one sight of it.
        if self._next_rival is None or sights.count > self._next_rival.count:
            self._next_rival = sights
        told = insertion is not None or come or sights.has_moved(tip, self._curvature)
        return told and sights.count >= wanted

    def pass_on(self) -> None:
        """Keep this pair's rival for the next: rivals win in a row, or not at all."""
        self._rival, self._next_rival = self._next_rival, None

    def miss(self) -> None:
        """Note a pair without a believed tip."""
        settings = self._settings
        self.pass_on()
        self._misses += 1
        if self.state is TrackState.TRACKING:
            if self._misses >= settings.lost_after:
                self.state = TrackState.LOST
        elif self.state is not TrackState.LOST and not self._may_confirm_yet():
            rival = self._rival
            self.drop()
            self._rival = rival
        patience = _PATIENCE if self.is_established else 1
        if self.state is TrackState.LOST and self._misses >= patience * settings.forget_after:
            self.drop()

    def _may_confirm_yet(self) -> bool:
        """Return whether a first tip may still be confirmed, though pairs without one came."""
        known = self.anchor is not None and self.anchor.insertion is not None
        confirming = self.state is TrackState.CONFIRMING
        return confirming and known and self._misses <= _CONFIRM_MISSES

    def hide(self) -> None:
        """Note a pair that shows the shaft where it should be, but its end in neither view."""
        self._hidden += 1
        self.pass_on()
        if self._hidden > _HIDDEN_PER_LOST * self._settings.lost_after:
            self.miss()

    def tolerance(self, predicted: Anchor) -> float:
        """Return how far a tip may be from where `predict` has it [m].

        The needle goes the stage's way, bending at most by its largest curvature, and its heading
        is known to a few degrees.
        """
        if not predicted.known:
            return self._settings.free_step * (self._misses + self._hidden + 1)
        return self._room(predicted.unseen)

    def _room(self, way: float) -> float:
        bend = 0.5 * self._curvature * way * way
        return self._settings.step_margin + _HEADING_TOLERANCE * abs(way) + bend
