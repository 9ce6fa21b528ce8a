"""Homing of a CiA 402 drive: methods 17 and 18 (limit switch), 35 and 37 (where it stands)."""

from __future__ import annotations

import enum

from needle_sim.drives.demand import Demand
from needle_sim.drives.motor import Motor

NEGATIVE_SWITCH = 17
POSITIVE_SWITCH = 18
CURRENT_POSITION = (35, 37)
METHODS = (NEGATIVE_SWITCH, POSITIVE_SWITCH, *CURRENT_POSITION)


class _Phase(enum.Enum):
    SEARCH = 1
    TURN = 2
    LEAVE = 3
    STOP = 4
    DONE = 5


class Homing:
    """One run towards a home position.

    Parameters
    ----------
    method : int
        One of `METHODS`.
    motor : Motor
        Whose switches are looked at.
    speed : float
        Towards the switch [counts/s]; no faster than the motor can.
    edge_speed : float
        Off the switch, whose edge is the home position [counts/s].
    acceleration : float
        [counts/s^2].
    """

    def __init__(
        self, method: int, motor: Motor, *, speed: float, edge_speed: float, acceleration: float
    ) -> None:
        self._motor = motor
        self._speed = min(speed, motor.max_speed)
        self._edge_speed = edge_speed
        self._acceleration = acceleration
        self._direction = 1.0 if method == POSITIVE_SWITCH else -1.0
        self.home_position = motor.position
        if method in CURRENT_POSITION:
            self._phase = _Phase.DONE
        else:
            self._phase = _Phase.LEAVE if self._touched else _Phase.SEARCH

    @property
    def done(self) -> bool:
        """Tell whether the axis stands and `home_position` (true counts) is known."""
        return self._phase is _Phase.DONE

    def advance(self, demand: Demand, period: float) -> None:
        """Move the demand on for `period` [s]."""
        if self._phase is _Phase.SEARCH:
            demand.run(self._direction * self._speed, self._acceleration, period)
            if self._touched:
                self._phase = _Phase.TURN
        elif self._phase is _Phase.TURN:
            demand.brake(self._acceleration, period)
            if demand.at_rest:
                self._phase = _Phase.LEAVE
        elif self._phase is _Phase.LEAVE:
            demand.run(-self._direction * self._edge_speed, self._acceleration, period)
            if not self._touched:
                # The drive latches the encoder at the edge itself.
                self.home_position = self._motor.travel if self._direction > 0.0 else 0.0
                self._phase = _Phase.STOP
        elif self._phase is _Phase.STOP:
            demand.brake(self._acceleration, period)
            if demand.at_rest:
                self._phase = _Phase.DONE

    @property
    def _touched(self) -> bool:
        motor = self._motor
        return motor.at_positive_switch if self._direction > 0.0 else motor.at_negative_switch
