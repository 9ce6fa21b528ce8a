"""Demand of a drive to its motor: set-points, trapezoids and ramps, in counts and seconds."""

from __future__ import annotations

import math


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
