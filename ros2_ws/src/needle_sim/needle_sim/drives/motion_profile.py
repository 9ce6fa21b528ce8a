"""Motion profiles of a drive in counts and seconds: set-points, trapezoids, ramps, homing."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator
from functools import partial

from needle_sim.drives.emulated_drives import MOTION_STEP
from needle_sim.drives.motor import Motor


class Demand:
    """Demanded position and velocity, advanced in small time steps.

    Parameters
    ----------
    position : float
        Initial position, at rest [counts].
    """

    def __init__(self, position: float) -> None:
        self.position = position
        self.velocity = 0.0
        self._segment_end = position
        self._segment_left = 0.0

    @property
    def at_rest(self) -> bool:
        """Whether no motion is under way."""
        return self.velocity == 0.0 and self._segment_left <= 0.0

    def hold(self, position: float) -> None:
        """Rest at `position`."""
        self.position = position
        self.velocity = 0.0
        self._segment_left = 0.0

    def begin_segment(self, end: float, duration: float) -> None:
        """Start a motion to `end` at constant velocity within `duration`."""
        self._segment_end = end
        self._segment_left = duration
        self.velocity = (end - self.position) / duration

    def interpolate(self, period: float) -> None:
        """Advance along the segment."""
        if self._segment_left <= 0.0:
            self.velocity = 0.0
            return
        # The tolerance prevents an extra step due to a rounding error.
        if period >= self._segment_left * (1.0 - 1e-9):
            self.position = self._segment_end
            self._segment_left = 0.0
            return
        self.velocity = (self._segment_end - self.position) / self._segment_left
        self.position += self.velocity * period
        self._segment_left -= period

    def brake(self, deceleration: float, period: float) -> None:
        """Decelerate along a ramp."""
        self._segment_left = 0.0
        slower = max(abs(self.velocity) - deceleration * period, 0.0)
        # Mean velocity of the ramp.
        mean = (abs(self.velocity) + slower) / 2.0
        if slower == 0.0 and deceleration > 0.0:
            mean *= min(abs(self.velocity) / (deceleration * period), 1.0)
        self.position += math.copysign(mean, self.velocity) * period
        self.velocity = math.copysign(slower, self.velocity) if slower > 0.0 else 0.0

    def run(self, velocity: float, acceleration: float, period: float) -> None:
        """Accelerate towards a velocity, and move."""
        self._segment_left = 0.0
        change = velocity - self.velocity
        limit = acceleration * period
        self.velocity += min(max(change, -limit), limit)
        self.position += self.velocity * period

    def approach(
        self,
        target: float,
        speed: float,
        acceleration: float,
        deceleration: float,
        period: float,
    ) -> bool:
        """Move towards `target` on a trapezoidal profile; return whether it is reached.

        The speed of a step is the largest from which the ramp still ends at the target:
        v^2 / (2 a) + v dt / 2 = distance.
        """
        distance = target - self.position
        ramp = deceleration * period
        fastest = (math.sqrt(ramp * ramp + 8.0 * deceleration * abs(distance)) - ramp) / 2.0
        velocity = math.copysign(min(speed, fastest), distance)
        close = abs(distance) <= max(abs(self.velocity) * period, 0.5)
        if close and abs(self.velocity) <= 2.0 * ramp:
            self.hold(target)
            return True
        self.run(velocity, max(acceleration, deceleration), period)
        return False


NEGATIVE_SWITCH = 17
POSITIVE_SWITCH = 18
CURRENT_POSITION = (35, 37)
METHODS = (NEGATIVE_SWITCH, POSITIVE_SWITCH, *CURRENT_POSITION)


def home(
    method: int, motor: Motor, demand: Demand, *, speed: float, edge_speed: float, ramp: float
) -> Generator[None, None, float]:
    """Home a motor: methods 17 and 18 (limit switch), 35 and 37 (present position).

    Each step of the generator advances the demand by `MOTION_STEP`. After the last one, the demand
    rests.

    Parameters
    ----------
    method : int
        One of `METHODS`.
    motor : Motor
        Motor with the switches.
    demand : Demand
        Demand of the motor.
    speed : float
        Speed towards the switch, limited by the motor [counts/s].
    edge_speed : float
        Speed away from the switch, whose edge is the home position [counts/s].
    ramp : float
        Acceleration and deceleration [counts/s^2].

    Returns
    -------
    float
        Home position [true counts].
    """
    if method in CURRENT_POSITION:
        return motor.position
    direction = 1.0 if method == POSITIVE_SWITCH else -1.0
    blocked = partial(motor.is_blocked, direction)
    run = partial(demand.run, acceleration=ramp, period=MOTION_STEP)
    brake = partial(demand.brake, ramp, MOTION_STEP)
    if not blocked():
        yield from _repeat(lambda: run(direction * min(speed, motor.max_speed)), blocked)
        yield
        yield from _repeat(brake, lambda: demand.at_rest)
        yield
    yield from _repeat(lambda: run(-direction * edge_speed), lambda: not blocked())
    yield
    yield from _repeat(brake, lambda: demand.at_rest)
    # The drive latched the encoder position at the edge.
    return motor.travel if direction > 0.0 else 0.0


def _repeat(step: Callable[[], None], is_done: Callable[[], bool]) -> Iterator[None]:
    """Repeat a step, once per iteration, until a condition holds after it."""
    step()
    while not is_done():
        yield
        step()
