"""Both joints on one straight way, in proportion at every moment."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class SetPoint:
    """Set-point: places of the joints after the next period, and their speeds.

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
    """A motion whose progress is one number, so that the joints cannot part when speed changes.

    Parameters
    ----------
    start, end : tuple of float
        Insertion [m] and rotation [rad].
    duration : float
        Time at full speed [s].
    """

    def __init__(
        self, start: tuple[float, float], end: tuple[float, float], duration: float
    ) -> None:
        self._start = start
        self.end = end
        self._duration = duration
        self._progress = 0.0

    @property
    def complete(self) -> bool:
        """Tell whether the last set-point was given."""
        return self._progress >= 1.0

    def advance(self, period: float, speed_scale: float) -> SetPoint:
        """Return the set-point `period` [s] later at `speed_scale` (0..1) of full speed."""
        rate = speed_scale / self._duration
        # Progress sums up rounding; without the margin a step could take a period of nothing more.
        self._progress += rate * period
        if self._progress > 1.0 - 1e-9:
            self._progress = 1.0
        return self._set_point(rate)

    def follow(self, insertion: float, max_rotation_rate: float, period: float) -> SetPoint:
        """Return the set-point for an insertion that a hand has reached.

        The rotation never goes back, and no faster than `max_rotation_rate` [rad/s] over the
        `period` [s]: after a push that was faster it comes in late.
        """
        way = self.end[0] - self._start[0]
        reached = min(max((insertion - self._start[0]) / way, self._progress), 1.0)
        turn = abs(self.end[1] - self._start[1])
        fastest = max_rotation_rate * period / turn if turn > 0.0 else 1.0
        step = min(reached - self._progress, fastest)
        self._progress += step
        return self._set_point(step / period)

    def _set_point(self, rate: float) -> SetPoint:
        insertion, rotation = (
            # Exactly the target at the end: start + (end - start) is not.
            end if self.complete else start + self._progress * (end - start)
            for start, end in zip(self._start, self.end, strict=True)
        )
        speeds = [rate * abs(end - start) for start, end in zip(self._start, self.end, strict=True)]
        return SetPoint(insertion, rotation, *speeds)
