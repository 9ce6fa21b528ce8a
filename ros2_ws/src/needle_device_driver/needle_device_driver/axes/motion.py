"""Coordinated motion of both joints along straight legs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence


@dataclasses.dataclass(frozen=True)
class Leg:
    """A straight piece of a path.

    Attributes
    ----------
    insertion, rotation : float
        Joint positions at its end [m], [rad].
    duration : float
        Duration at full speed [s].
    """

    insertion: float
    rotation: float
    duration: float


@dataclasses.dataclass(frozen=True)
class SetPoint:
    """Joint positions after the next period, and the speeds to get there.

    Attributes
    ----------
    insertion, rotation : float
        Targets [m], [rad].
    insertion_speed, rotation_speed : float
        Speeds [m/s], [rad/s], not negative.
    """

    insertion: float
    rotation: float
    insertion_speed: float
    rotation_speed: float


class CoordinatedMotion:
    """Motion along legs; both joints share one progress value, so they stay in proportion.

    Parameters
    ----------
    start : tuple of float
        Insertion [m] and rotation [rad].
    legs : sequence of Leg
        The path from there, at least one leg.
    """

    def __init__(self, start: tuple[float, float], legs: Sequence[Leg]) -> None:
        self._start = self._at = start
        self._legs = tuple(legs)
        self._leg = 0
        # Within the current leg, 0..1.
        self._progress = 0.0

    @property
    def complete(self) -> bool:
        """Whether the last set-point was returned."""
        return self._is_last and self._progress >= 1.0

    def advance(self, period: float, speed_scale: float) -> SetPoint:
        """Return the set-point `period` [s] later at `speed_scale` (0..1) of full speed."""
        left = period
        rate = speed_scale / self._legs[self._leg].duration
        while not self._is_last and self._progress + rate * left >= 1.0:
            left -= (1.0 - self._progress) / rate
            self._next_leg()
            rate = speed_scale / self._legs[self._leg].duration
        # The margin absorbs rounding errors, which could otherwise add a period without motion.
        self._progress += rate * left
        if self._progress > 1.0 - 1e-9:
            self._progress = 1.0
        return self._set_point(period)

    def follow(self, insertion: float, max_rotation_rate: float, period: float) -> SetPoint:
        """Return the set-point for an insertion that was reached by hand.

        The rotation never reverses. Its rate is at most `max_rotation_rate` [rad/s] over the
        `period` [s], so it lags behind a faster push.
        """
        turn = max_rotation_rate * period
        while True:
            leg = self._legs[self._leg]
            length, whole = leg.insertion - self._start[0], abs(leg.rotation - self._start[1])
            # The needle may have passed the leg before its rotation began.
            part = (insertion - self._start[0]) / length if length > 0.0 else 1.0
            reached = min(max(part, self._progress), 1.0)
            step = min(reached - self._progress, turn / whole if whole > 0.0 else 1.0)
            self._progress += step
            turn -= step * whole
            if self._progress < 1.0 or self._is_last:
                return self._set_point(period)
            self._next_leg()

    def rotation_at(self, insertion: float) -> float:
        """Return the rotation that belongs to an insertion, clamped to the path [rad]."""
        start = self._start
        for leg in self._legs[self._leg :]:
            if insertion < leg.insertion:
                part = max(insertion - start[0], 0.0) / (leg.insertion - start[0])
                return start[1] + part * (leg.rotation - start[1])
            start = leg.insertion, leg.rotation
        return start[1]

    @property
    def _is_last(self) -> bool:
        return self._leg == len(self._legs) - 1

    def _next_leg(self) -> None:
        leg = self._legs[self._leg]
        self._start = leg.insertion, leg.rotation
        self._leg += 1
        self._progress = 0.0

    def _position(self) -> tuple[float, float]:
        leg = self._legs[self._leg]
        if self._progress >= 1.0:
            # Exactly the target: start + (end - start) may differ from it by rounding.
            return leg.insertion, leg.rotation
        insertion, rotation = self._start
        return (
            insertion + self._progress * (leg.insertion - insertion),
            rotation + self._progress * (leg.rotation - rotation),
        )

    def _set_point(self, period: float) -> SetPoint:
        before, self._at = self._at, self._position()
        speeds = [abs(b - a) / period for a, b in zip(before, self._at, strict=True)]
        return SetPoint(*self._at, *speeds)


def slowed_legs(
    start: tuple[float, float],
    legs: Sequence[Leg],
    max_speed: float,
    max_rotation_rate: float,
) -> tuple[Leg, ...]:
    """Return the legs with durations that respect both bounds.

    Parameters
    ----------
    start : tuple of float
        Insertion [m] and rotation [rad] at the start of the first leg.
    legs : sequence of Leg
        The path.
    max_speed, max_rotation_rate : float
        The bounds [m/s], [rad/s].
    """
    slowed = []
    for leg in legs:
        shortest = max(
            abs(leg.insertion - start[0]) / max_speed,
            abs(leg.rotation - start[1]) / max_rotation_rate,
        )
        slowed.append(dataclasses.replace(leg, duration=max(leg.duration, shortest)))
        start = leg.insertion, leg.rotation
    return tuple(slowed)
