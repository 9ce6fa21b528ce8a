"""Whether a measured tip is believed: physical gates, and the track's state.

Nothing here looks at images: measured tips and insertions come in as arguments, decisions go out as
data.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from needle_tracker.search_grid import Reach
from needle_tracker.triangulation import SpatialTip

Array = NDArray[np.float64]

DISAGREE_ALONG = "views disagree along the needle"
_WAY_TIPS = 64
_WAY_LENGTH = 2.5e-3  # long enough for a heading, short enough to follow a bend [m]
_HEADING_TOLERANCE = 0.12  # [rad]
_HIDDEN_PER_LOST = 4
# Of a prediction: what moves at rest, and how well the heading is known.
_DRIFT = 0.05e-3  # [m]
_HEADING_SIGMA = 0.06  # [rad]
_LARGEST_SURPRISE = 25.0  # squared, over its covariance


class TrackState(enum.Enum):
    """What the tracker knows about the needle."""

    SEARCHING = "SEARCHING"  # nothing is known: the whole reachable region is searched
    CONFIRMING = "CONFIRMING"  # something like a needle, not believed yet
    TRACKING = "TRACKING"
    LOST = "LOST"  # was tracked and is not seen; found again only where it can have got to
    ENTRY = "ENTRY"  # too short to be seen: the tip follows from the insertion


@dataclasses.dataclass(frozen=True)
class GateSettings:
    """Bounds that a believed tip keeps.

    Attributes
    ----------
    reach : Reach
        What the needle can do.
    surface_height : float
        x of the phantom's surface [m].
    least_distance : float
        Least distance from the entry at which a tip can be seen [m].
    tip_lean : float
        Largest angle between the visible end and the path (pre-bend) [rad].
    insertion_margin : float
        Tolerance between tip and insertion [m].
    step_margin : float
        Tolerance of the tip against where the last one and the insertion have it [m].
    free_step : float
        Largest move per pair where the insertion is not known [m].
    max_disagreement : float
        Largest disagreement of the views along the needle [m].
    max_miss_px : float
        Largest distance of the tip from the image lines [px].
    max_depth_sigma : float
        Largest standard deviation in any direction [m].
    confirm_pairs : int
        Successive pairs that agree before a tip is believed without a known insertion.
    lost_after : int
        Successive pairs without a believed tip until the track is lost.
    forget_after : int
        Successive pairs without a believed tip until the last place no longer counts.
    """

    reach: Reach
    surface_height: float
    least_distance: float
    tip_lean: float
    insertion_margin: float
    step_margin: float
    free_step: float
    max_disagreement: float
    max_miss_px: float
    max_depth_sigma: float
    confirm_pairs: int
    lost_after: int
    forget_after: int


@dataclasses.dataclass(frozen=True)
class Anchor:
    """The last believed tip, or where it should be now.

    Attributes
    ----------
    position : ndarray, shape (3,)
        In `rig` [m].
    direction : ndarray, shape (3,)
        Unit vector along the visible end.
    heading : ndarray, shape (3,)
        Unit vector of where the tip is going: of its way so far, where there is enough.
    insertion : float or None
        Of that moment [m].
    covariance : ndarray, shape (3, 3)
        Of the position [m^2].
    ahead : float
        How far this is ahead of the last believed tip [m].
    """

    position: Array
    direction: Array
    heading: Array
    insertion: float | None
    covariance: Array
    ahead: float = 0.0


def refusal(tip: SpatialTip, insertion: float | None, settings: GateSettings) -> str | None:
    """Return why a measured tip cannot be the needle's, None where it can.

    Parameters
    ----------
    tip : SpatialTip
        Measured tip in `rig`.
    insertion : float or None
        Length of needle in the phantom at the exposure [m], None where unknown.
    settings : GateSettings
        The bounds.

    Returns
    -------
    str or None
        Short reason, the same for the same gate (it is counted by).
    """
    reach, margin = settings.reach, settings.insertion_margin
    distance = max(float(np.linalg.norm(tip.position)), 1e-9)
    largest_sigma = math.sqrt(float(np.linalg.eigvalsh(tip.covariance)[-1]))
    path_length = distance if insertion is None else max(insertion, distance)
    # Steered ever the same way, and a little more for what the margins leave open.
    largest_turn = 1.3 * path_length * reach.curvature + reach.entry_angle + settings.tip_lean
    checks = [
        (tip.disagreement > settings.max_disagreement, DISAGREE_ALONG),
        (tip.disagreement_across > settings.max_miss_px, "views disagree across the needle"),
        (largest_sigma > settings.max_depth_sigma, "too uncertain"),
        (tip.position[0] > settings.surface_height, "above the surface"),
        (distance < settings.least_distance, "too close to the entry"),
        (distance > reach.length + margin, "beyond the longest insertion"),
        (
            _angle_to_z(tip.position / distance) > float(reach.chord_angle(np.array(distance))),
            "outside the reachable cone",
        ),
        (_angle_to_z(tip.direction) > largest_turn, "direction not reachable"),
    ]
    if insertion is not None:
        shortest = reach.shortest_chord(insertion)
        checks.append((distance > insertion + margin, "farther than the insertion"))
        checks.append((distance < shortest - margin, "short of the insertion"))
    return next((reason for failed, reason in checks if failed), None)


def _angle_to_z(unit: Array) -> float:
    return math.acos(min(max(float(unit[2]), -1.0), 1.0))


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
        self._way: deque[Anchor] = deque(maxlen=_WAY_TIPS)
        self._misses = 0
        self._hidden = 0
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
        ahead = 0.0
        if insertion is not None and anchor.insertion is not None:
            ahead = insertion - anchor.insertion
        position = anchor.position + ahead * anchor.heading
        sideways = _DRIFT + _HEADING_SIGMA * abs(ahead)
        covariance = anchor.covariance + sideways**2 * np.eye(3)
        return dataclasses.replace(
            anchor, position=position, insertion=insertion, covariance=covariance, ahead=ahead
        )

    def judge(self, tip: SpatialTip, insertion: float | None) -> str | None:
        """Return why a measured tip is not believed, None where it passes all gates."""
        reason = refusal(tip, insertion, self._settings)
        if reason is None and self.anchor is not None:
            predicted = self.predict(insertion)
            if predicted is not None:
                miss = float(np.linalg.norm(tip.position - predicted.position))
                if miss > self.tolerance(predicted):
                    return "too far from the last tip"
                if predicted.insertion is not None and self.state is TrackState.TRACKING:
                    off = tip.position - predicted.position
                    spread = predicted.covariance + tip.covariance
                    if float(off @ np.linalg.solve(spread, off)) > _LARGEST_SURPRISE:
                        return "too far from the prediction"
        return reason

    def accept(self, tip: SpatialTip, insertion: float | None) -> bool:
        """Take a tip that passed `judge`; return whether it is believed from now on."""
        if self.state is not TrackState.TRACKING:
            known = insertion is not None
            self._agreeing = self._agreeing + 1 if self.state is TrackState.CONFIRMING else 1
            wanted = 1 if known else self._settings.confirm_pairs
            confirmed = self._agreeing >= wanted
            self.state = TrackState.TRACKING if confirmed else TrackState.CONFIRMING
        position, covariance = tip.position, tip.covariance
        self._misses = self._hidden = 0
        heading = self._heading(position, tip.direction, insertion)
        self.anchor = Anchor(position, tip.direction, heading, insertion, covariance)
        self._way.append(self.anchor)
        return self.state is TrackState.TRACKING

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
        if predicted.insertion is None or self.anchor is None or self.anchor.insertion is None:
            return settings.free_step * (self._misses + self._hidden + 1)
        ahead = abs(predicted.ahead)
        bend = 0.5 * settings.reach.curvature * ahead * ahead
        return settings.step_margin + _HEADING_TOLERANCE * ahead + bend

    def merged(self, tip: SpatialTip, insertion: float | None) -> SpatialTip:
        """Return a tip merged with its prediction: a view that something spoils counts less.

        In clear images the measurement is so much better than the prediction that it hardly moves.
        """
        predicted = self.predict(insertion)
        known = predicted is not None and predicted.insertion is not None
        if predicted is None or not known or self.state is not TrackState.TRACKING:
            return tip
        gain = predicted.covariance @ np.linalg.inv(predicted.covariance + tip.covariance)
        position = predicted.position + gain @ (tip.position - predicted.position)
        covariance = (np.eye(3) - gain) @ predicted.covariance
        covariance = 0.5 * (covariance + covariance.T)
        return dataclasses.replace(tip, position=position, covariance=covariance)

    def _heading(self, position: Array, direction: Array, insertion: float | None) -> Array:
        """Return the way of the last millimetres; the visible end's direction before that."""
        if insertion is None:
            return direction
        for old in reversed(self._way):
            if old.insertion is None or old.insertion > insertion:
                break
            if insertion - old.insertion >= _WAY_LENGTH:
                way = position - old.position
                return np.asarray(way / np.linalg.norm(way))
        return direction


def tip_at_entry(insertion: float, hole_tolerance: float, entry_angle: float) -> SpatialTip:
    """Return the tip of a needle that is too short to be seen.

    Parameters
    ----------
    insertion : float
        Length of needle beyond the entry point [m].
    hole_tolerance : float
        Standard deviation of the path's place at the entry [m].
    entry_angle : float
        Standard deviation of the heading at the entry [rad].

    Returns
    -------
    SpatialTip
        On the z axis of `rig`, with the covariance that follows.
    """
    sideways = math.hypot(hole_tolerance, insertion * math.sin(entry_angle))
    along = math.hypot(hole_tolerance, insertion * (1.0 - math.cos(entry_angle)))
    return SpatialTip(
        np.array([0.0, 0.0, insertion]),
        np.diag([sideways**2, sideways**2, along**2]),
        np.array([0.0, 0.0, 1.0]),
        np.diag([entry_angle**2, entry_angle**2, 0.0]),
        0.0,
        0.0,
    )
