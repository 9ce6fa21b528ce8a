"""The motor and the stage behind a drive: where things really are, switches and stops included."""

from __future__ import annotations

import dataclasses
import math

# From a limit switch's edge to the mechanical stop [m].
_BEYOND = 0.003


@dataclasses.dataclass(frozen=True)
class MotorSettings:
    """Mechanics of an axis; counts and seconds.

    Attributes
    ----------
    counts_per_unit : float
        Encoder counts per m or rad.
    max_speed : float
        Fastest that the motor can turn [counts/s].
    lag : float
        Time constant with which it follows the drive's demand [s]; 0 follows at once.
    start : float
        Position at power-up, from the home switch's edge [counts].
    travel : float
        From the edge of the negative to that of the positive limit switch [counts]; infinite for
        an axis without switches.
    """

    counts_per_unit: float
    max_speed: float
    lag: float = 0.0
    start: float = 0.0
    travel: float = math.inf


class Motor:
    """One motor. Positions are true ones in counts from the edge of the negative limit switch.

    Parameters
    ----------
    settings : MotorSettings
        The mechanics.
    """

    # Closer to the demand than this, a lagging motor is there [counts].
    _CLOSE = 0.01

    def __init__(self, settings: MotorSettings) -> None:
        self._settings = settings
        self.max_speed = settings.max_speed
        self.position = settings.start
        self.velocity = 0.0
        self.stalled = False

    @property
    def at_negative_switch(self) -> bool:
        """Tell whether the negative limit switch is touched; its edge is position 0."""
        return self._has_switches and self.position < 0.0

    @property
    def at_positive_switch(self) -> bool:
        """Tell whether the positive limit switch is touched."""
        return self._has_switches and self.position > self._settings.travel

    @property
    def travel(self) -> float:
        """Edge of the positive limit switch [counts]."""
        return self._settings.travel

    def follow(self, demand: float, period: float) -> None:
        """Move towards the demanded position for `period` [s]."""
        before = self.position
        way = demand - before
        if self.stalled or way == 0.0:
            self.velocity = 0.0
            return
        lag = self._settings.lag
        if lag > 0.0 and abs(way) > self._CLOSE:
            way *= -math.expm1(-period / lag)
        most = self.max_speed * period
        way = min(max(way, -most), most)
        self.position = demand if way == demand - before else before + way
        if self._has_switches:
            beyond = _BEYOND * self._settings.counts_per_unit
            self.position = min(max(self.position, -beyond), self._settings.travel + beyond)
        self.velocity = (self.position - before) / period

    def rest(self) -> None:
        """Stand still: without power the friction of screw and gear holds at once."""
        self.velocity = 0.0

    @property
    def _has_switches(self) -> bool:
        return math.isfinite(self._settings.travel)
