"""Conditions on a measured tip to be the needle's at all: physics, not history."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from needle_tracker.image.search_grid import Reach
from needle_tracker.optics.window import Window
from needle_tracker.tracking.refusals import NoTip
from needle_tracker.tracking.triangulation import SpatialTip

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class GateSettings:
    """Bounds that a believed tip keeps.

    Attributes
    ----------
    reach : Reach
        What the needle can do.
    windows : tuple of Window
        What the cameras look through: the needle is behind each of them.
    least_distance : float
        Least distance from the entry at which a tip can be seen [m].
    tip_lean : float
        Largest angle between the visible end and the path (pre-bend) [rad].
    insertion_margin : float
        Tolerance between tip and insertion [m].
    step_margin : float
        Tolerance of the tip against where the last one and the insertion have it [m].
    free_step : float
        Largest move per pair where the insertion is not known [m]; an end that has come may be
        anywhere.
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
    windows: tuple[Window, ...]
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
        (tip.disagreement > settings.max_disagreement, NoTip.DISAGREE_ALONG),
        (tip.disagreement_across > settings.max_miss_px, NoTip.DISAGREE_ACROSS),
        (largest_sigma > settings.max_depth_sigma, NoTip.UNCERTAIN),
        (
            any(window.depth(tip.position) < 0.0 for window in settings.windows),
            NoTip.OUTSIDE,
        ),
        (distance < settings.least_distance, NoTip.NEAR_ENTRY),
        (distance > reach.length + margin, NoTip.BEYOND_REACH),
        (
            _angle_to_z(tip.position / distance) > float(reach.chord_angle(np.array(distance))),
            NoTip.OUTSIDE_CONE,
        ),
        (_angle_to_z(tip.direction) > largest_turn, NoTip.DIRECTION),
    ]
    if insertion is not None:
        shortest = reach.shortest_chord(insertion)
        checks.append((distance > insertion + margin, NoTip.BEYOND_INSERTION))
        checks.append((distance < shortest - margin, NoTip.SHORT_OF_INSERTION))
    return next((reason for failed, reason in checks if failed), None)


def _angle_to_z(unit: Array) -> float:
    return math.acos(min(max(float(unit[2]), -1.0), 1.0))


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
