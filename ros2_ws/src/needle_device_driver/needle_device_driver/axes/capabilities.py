"""Abilities of a kind of drive, on which the bounds of some safety rules depend."""

from __future__ import annotations

import dataclasses
import math


@dataclasses.dataclass(frozen=True)
class Capabilities:
    """Abilities of a drive; the motion supervisor makes up for missing ones.

    Attributes
    ----------
    watchdog : float
        Silence of the computer after which it stops by itself, with the default parameter
        `watchdog` [s]; infinite: it has no watchdog.
    longest_order : float
        Longest time for which the last set-point keeps it moving [s]; for a drive
        with trapezoidal profiles 0.02 s + speed / deceleration.
    response_time : float
        Delay from an order to its effect in the feedback [s]; at least one cycle (0.02 s), more if
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
        """Whether the drive stops on its own when the computer is silent."""
        return math.isfinite(self.watchdog)
