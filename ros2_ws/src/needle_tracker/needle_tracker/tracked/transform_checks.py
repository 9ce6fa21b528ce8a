"""Validity checks of the transforms of a tracker.

A rejection is a pair: the name of the fault, which is counted, and a text with value and bound.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rejection = tuple[str, str]

_CONFIRMED_BY = 3  # consecutive transforms that agree, before the first tip and after a jump
_SMALLEST_SCALE, _LARGEST_SCALE = 0.85, 1.15  # motion of the tip per insertion of the stage
_LARGEST_CURVATURE = 9.0  # of the needle's path, as for stereo_tracker [1/m]
_LARGEST_ANGLE = 1.4  # between heading and insertion [rad]
_MARGIN = 4e-3  # for the errors of registration and entry point, as for plane_controller [m]
_GATE = 6.0  # for the noise of a change of place [standard deviations]
_OLDER_GATES = 3.0  # insertion after which an older tip is replaced [gates]
_OUT = 1e-3  # insertion up to which the needle counts as withdrawn [m]
_ROTATION_TOLERANCE = 1e-3  # of R R^T = 1; single precision has 1e-6
_AHEAD = 0.05  # tolerated difference of two clocks [s]


class TrackerTransform(NamedTuple):
    """A transform as received.

    Attributes
    ----------
    stamp : float
        Time of the measurement [s] since 1970; 0 if there is none.
    matrix : ndarray, shape (4, 4)
        Pose of the sensor in the tracker's frame; translation in the sender's unit.
    status : str
        The tracker's own assessment: OK, MISSING, OUT_OF_VOLUME; empty if it sends none.
    """

    stamp: float
    matrix: Array
    status: str = ""


def check_transform(
    transform: TrackerTransform, last: TrackerTransform | None, now: float, max_age: float
) -> Rejection | None:
    """Check a transform independently of the needle; return the rejection, or None.

    Parameters
    ----------
    transform, last : TrackerTransform
        The transform, and the last one that passed, if any.
    now : float
        Present time [s] since 1970.
    max_age : float
        Largest age on arrival [s].
    """
    matrix, age = transform.matrix, now - transform.stamp
    rejection = None
    if transform.status not in ("", "OK"):
        rejection = "status", f"the tracker reports {transform.status}, expected OK"
    elif not (np.all(np.isfinite(matrix)) and math.isfinite(age)):
        rejection = "not_finite", "a number of the transform or its stamp"
    elif lack := _lack_of_rotation(matrix[:3, :3]):
        rejection = "not_a_rotation", lack
    elif not -_AHEAD <= age <= max_age:
        rejection = "clock", f"stamp {age:.3g} s old, bounds [{-_AHEAD:g}, {max_age:g}] s"
    elif last is not None and transform.stamp <= last.stamp:
        rejection = "not_newer", f"stamp {last.stamp - transform.stamp:.3g} s before the last one's"
    elif last is not None and np.array_equal(matrix, last.matrix):
        rejection = "frozen", "all numbers equal those of the last transform"
    return rejection


def _lack_of_rotation(rotation: Array) -> str:
    determinant = float(np.linalg.det(rotation))
    off = float(np.max(np.abs(rotation @ rotation.T - np.eye(3))))
    if determinant > 0.0 and off <= _ROTATION_TOLERANCE:
        return ""
    return f"determinant {determinant:.4g}, expected 1; R R^T differs from 1 by {off:.3g}"


class Place(NamedTuple):
    """A measured tip [m] and heading in `rig`, and the insertion at its measurement [m]."""

    position: Array
    heading: Array
    insertion: float


class PlaceCheck:
    """Checks tips against the insertion, and against an earlier tip.

    Parameters
    ----------
    noise : float
        Standard deviation of a measured coordinate [m].
    """

    def __init__(self, noise: float) -> None:
        self._gate = _GATE * noise
        # The last tip reveals a jump, an older one a sensor that does not follow the needle.
        self._last: Place | None = None
        self._older: Place | None = None
        self._agreeing = 0
        self._is_steady = False

    def check(self, place: Place) -> Rejection | None:
        """Return the rejection of a tip, or None."""
        depth, distance = place.insertion, math.hypot(*place.position)
        # The shortest chord is that of an arc of the largest curvature.
        chord = 2.0 / _LARGEST_CURVATURE * math.sin(0.5 * _LARGEST_CURVATURE * max(depth, 0.0))
        if text := _beyond(distance, chord, abs(depth), _MARGIN):
            return "out_of_range", f"distance from the entry point {text}"
        angle = math.acos(min(max(float(place.heading[2]), -1.0), 1.0))
        if angle > _LARGEST_ANGLE:
            return "heading", f"{angle:.3g} rad from the insertion, limit {_LARGEST_ANGLE:g} rad"
        return self._compare(place)

    def _compare(self, place: Place) -> Rejection | None:
        last, older = self._last or place, self._older or place
        self._is_steady &= place.insertion > _OUT
        text = self._disagreement(last, place) or self._disagreement(older, place)
        self._agreeing = 0 if text else self._agreeing + 1
        is_confirmed = self._agreeing >= _CONFIRMED_BY
        self._is_steady |= is_confirmed
        if is_confirmed or not self._is_steady:
            self._last = place
            is_far = abs(place.insertion - older.insertion) > _OLDER_GATES * self._gate
            self._older = place if is_far or not self._is_steady else older
        if text:
            return "jump", f"distance from an earlier tip {text}"
        few = f"{self._agreeing} transforms agree, {_CONFIRMED_BY} needed"
        return None if is_confirmed else ("unconfirmed", few)

    def _disagreement(self, earlier: Place, place: Place) -> str:
        inserted = abs(place.insertion - earlier.insertion)
        moved = math.hypot(*(place.position - earlier.position))
        return _beyond(moved, inserted, inserted, self._gate)


def _beyond(distance: float, least: float, most: float, margin: float) -> str:
    """Return how a distance contradicts an inserted length; empty if it does not."""
    near, far = max(_SMALLEST_SCALE * least - margin, 0.0), _LARGEST_SCALE * most + margin
    return "" if near <= distance <= far else f"{distance:.4g} m, bounds [{near:.4g}, {far:.4g}] m"
