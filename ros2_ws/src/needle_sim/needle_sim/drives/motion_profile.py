"""Motion profiles of a drive: set-points, trapezoids, ramps and homing; counts and seconds."""

from __future__ import annotations

import enum
import math

from needle_sim.drives.motor import Motor


class Demand:
    """The demanded position and velocity, advanced in small steps of time.

    Parameters
    ----------
    position : float
        Where it starts, at rest [counts].
    """

    def __init__(self, position: float) -> None:
        self.position = position
        self.velocity = 0.0
        self._segment_end = position
        self._segment_left = 0.0

    @property
    def at_rest(self) -> bool:
        """Tell whether nothing is under way."""
        return self.velocity == 0.0 and self._segment_left <= 0.0

    def hold(self, position: float) -> None:
        """Be at rest at `position`."""
        self.position = position
        self.velocity = 0.0
        self._segment_left = 0.0

    def begin_segment(self, end: float, duration: float) -> None:
        """Go to `end` at constant velocity within `duration`, and stop there."""
        self._segment_end = end
        self._segment_left = duration
        self.velocity = (end - self.position) / duration

    def interpolate(self, period: float) -> None:
        """Go on along the segment."""
        if self._segment_left <= 0.0:
            self.velocity = 0.0
            return
        # Rounding must not leave a remainder of a segment.
        if period >= self._segment_left * (1.0 - 1e-9):
            self.position = self._segment_end
            self._segment_left = 0.0
            return
        self.velocity = (self._segment_end - self.position) / self._segment_left
        self.position += self.velocity * period
        self._segment_left -= period

    def brake(self, deceleration: float, period: float) -> None:
        """Slow down along a ramp."""
        self._segment_left = 0.0
        slower = max(abs(self.velocity) - deceleration * period, 0.0)
        # The mean of the velocities before and after, as a ramp has it.
        mean = (abs(self.velocity) + slower) / 2.0
        if slower == 0.0 and deceleration > 0.0:
            mean *= min(abs(self.velocity) / (deceleration * period), 1.0)
        self.position += math.copysign(mean, self.velocity) * period
        self.velocity = math.copysign(slower, self.velocity) if slower > 0.0 else 0.0

    def run(self, velocity: float, acceleration: float, period: float) -> None:
        """Change towards a velocity, and move."""
        self._segment_left = 0.0
        change = velocity - self.velocity
        most = acceleration * period
        self.velocity += min(max(change, -most), most)
        self.position += self.velocity * period

    def approach(
        self,
        target: float,
        speed: float,
        acceleration: float,
        deceleration: float,
        period: float,
    ) -> bool:
        """Go to `target` along a trapezoid of velocity; returns whether it is there.

        The speed of a step is the largest from which the ramp still ends at the target:
        v^2 / (2 a) + v dt / 2 = distance.
        """
        distance = target - self.position
        ramp = deceleration * period
        fastest = (math.sqrt(ramp * ramp + 8.0 * deceleration * abs(distance)) - ramp) / 2.0
        wanted = math.copysign(min(speed, fastest), distance)
        close = abs(distance) <= max(abs(self.velocity) * period, 0.5)
        if close and abs(self.velocity) <= 2.0 * ramp:
            self.hold(target)
            return True
        self.run(wanted, max(acceleration, deceleration), period)
        return False


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
