"""Abilities of a kind of drive, on which the bounds of some safety rules depend."""

from __future__ import annotations

import dataclasses
import math


@dataclasses.dataclass(frozen=True)
class Capabilities:
    """Abilities of a drive; the motion supervisor does the rest.

    Attributes
    ----------
    watchdog : float
        Time without the computer after which it stops by itself, with the default parameter
        `watchdog` [s]; infinite: it has no watchdog.
    longest_order : float
        Longest time that a set-point keeps it moving if no further one follows [s]; for a drive
        with trapezoidal profiles 0.02 s + speed / deceleration.
    response_time : float
        From an order to its effect in the feedback [s]; at least one cycle of 0.02 s, and more if
        the drive filters its motion or its answers are old.
    encoder : bool
        Whether it measures its position; otherwise it counts its own steps.
    switches : bool
        Whether it reports its limit switches.
    limits : bool
        Whether it has software limits.
    identity : bool
        Whether its answers show a restart.
    exclusive : bool
        Whether it refuses or reports the orders of another computer.
    """

    watchdog: float
    longest_order: float
    response_time: float
    encoder: bool
    switches: bool
    limits: bool
    identity: bool
    exclusive: bool

    @property
    def has_watchdog(self) -> bool:
        """Whether it stops by itself without the computer."""
        return math.isfinite(self.watchdog)
