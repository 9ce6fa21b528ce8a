"""Motor and stage of a drive: true position, limit switches and mechanical stops."""

from __future__ import annotations

import dataclasses
import math

# Distance from the edge of a limit switch to the mechanical stop [m].
_STOP_DISTANCE = 0.003


@dataclasses.dataclass(frozen=True)
class MotorSettings:
    """Mechanics of an axis, in counts and seconds.

    Attributes
    ----------
    counts_per_unit : float
        Encoder counts per m or rad.
    max_speed : float
        Maximum speed [counts/s].
    lag : float
        Time constant of the lag behind the demand [s]; 0: no lag.
    start : float
        Position at power-up, from the home switch's edge [counts].
    travel : float
        Distance between the edges of both limit switches [counts]; infinite without switches.
    """

    counts_per_unit: float
    max_speed: float
    lag: float = 0.0
    start: float = 0.0
    travel: float = math.inf


class Motor:
    """Motor; true positions count from the edge of the negative limit switch [counts].

    Parameters
    ----------
    settings : MotorSettings
        Mechanics of the axis.
    """

    # Distance at which a lagging motor has reached the demand [counts].
    _TOLERANCE = 0.01

    def __init__(self, settings: MotorSettings) -> None:
        self._settings = settings
        self.scale = settings.counts_per_unit
        self.max_speed = settings.max_speed
        self.position = settings.start
        self.velocity = 0.0
        self.stalled = False

    @property
    def at_negative_switch(self) -> bool:
        """Whether the negative limit switch is active; its edge is position 0."""
        return self._has_switches and self.position < 0.0

    @property
    def at_positive_switch(self) -> bool:
        """Whether the positive limit switch is active."""
        return self._has_switches and self.position > self._settings.travel

    def is_blocked(self, direction: float) -> bool:
        """Return whether the limit switch in a direction is active."""
        return (direction < 0.0 and self.at_negative_switch) or (
            direction > 0.0 and self.at_positive_switch
        )

    @property
    def travel(self) -> float:
        """Edge of the positive limit switch [counts]."""
        return self._settings.travel

    def follow(self, demand: float, period: float) -> None:
        """Move towards the demanded position for `period` [s]."""
        before = self.position
        step = demand - before
        if self.stalled or step == 0.0:
            self.velocity = 0.0
            return
        lag = self._settings.lag
        if lag > 0.0 and abs(step) > self._TOLERANCE:
            step *= -math.expm1(-period / lag)
        limit = self.max_speed * period
        step = min(max(step, -limit), limit)
        self.position = demand if step == demand - before else before + step
        if self._has_switches:
            margin = _STOP_DISTANCE * self.scale
            self.position = min(max(self.position, -margin), self._settings.travel + margin)
        self.velocity = (self.position - before) / period

    def rest(self) -> None:
        """Stop at once: without power, the friction of screw and gear holds the axis."""
        self.velocity = 0.0

    @property
    def _has_switches(self) -> bool:
        return math.isfinite(self._settings.travel)
