"""Rule `axis_speed`: bounds the measured speed of an axis by its commanded speed."""

from __future__ import annotations

import math

from needle_device_driver.axes.axis_settings import AxisSettings

# Speed bound: this factor times the commanded speed, plus a margin in [m/s] or [rad/s].
_FACTOR = 1.5
_MARGINS = {"m": 5e-4, "rad": 0.1}
# Number of consecutive cycles above the bound that count as a fault. One is not enough: it also
# occurs when a drive sets its position to 0 at home.
_MAX_FAST_CYCLES = 2
# Time constant of a motor that lags behind its set-points [s].
_LONGEST_LAG = 0.2


class SpeedMonitor:
    """Rule `axis_speed`: compares the speed of an axis with its commanded speed.

    Parameters
    ----------
    settings : AxisSettings
        Settings of the axis.
    period : float
        Period of a cycle [s].

    Attributes
    ----------
    problem : str
        Description of the excessive speed; empty: none.
    """

    def __init__(self, settings: AxisSettings, period: float) -> None:
        self._settings = settings
        self._period = period
        # The commanded speed decays no faster than the axis slows down.
        self._decay = math.exp(-period / max(settings.stop_time, _LONGEST_LAG))
        self.reset()

    def reset(self) -> None:
        """Restart without a commanded speed."""
        self._commanded = 0.0
        self._fast_cycles = 0
        self.problem = ""

    def command(self, speed: float) -> None:
        """Note the commanded speed of the next cycle [m/s or rad/s]."""
        self._commanded = max(self._commanded, speed)

    def check(self, moved: float, periods: int, *, powered: bool) -> bool:
        """Return whether a motion of `moved` [m or rad] in `periods` cycles was slow enough."""
        settings, commanded = self._settings, self._commanded
        speed = abs(moved) / (periods * self._period)
        bound = _FACTOR * commanded + _MARGINS[settings.unit]
        self._commanded *= self._decay
        is_fast = powered and speed > bound
        self._fast_cycles = self._fast_cycles + 1 if is_fast else 0
        if self._fast_cycles >= _MAX_FAST_CYCLES and not self.problem:
            self.problem = (
                f"moves at {settings.text(speed)}/s, limit {settings.text(bound)}/s at "
                f"{settings.text(commanded)}/s commanded"
            )
        return not is_fast
