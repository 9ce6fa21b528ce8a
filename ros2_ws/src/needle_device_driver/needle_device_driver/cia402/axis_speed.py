"""Rule `axis_speed`: an axis goes no faster than it was told."""

from __future__ import annotations

import math

from needle_device_driver.cia402.drive_monitor import Feedback
from needle_device_driver.cia402.drive_settings import DriveSettings

# Bound: this factor times the commanded speed, plus a margin by the axis' unit [m/s], [rad/s].
_FACTOR = 1.5
_MARGINS = {"m": 5e-4, "rad": 0.1}
# Answered cycles in a row that are too fast. One is no fault: a drive makes one when it sets its
# position to 0 at home.
_TOO_FAST = 2
# Time constant of a motor that lags behind its set-points [s].
_LONGEST_LAG = 0.2


class SpeedWatch:
    """Compares the speed of an axis with its commanded speed.

    Parameters
    ----------
    settings : DriveSettings
        The axis' drive.
    period : float
        Of the SYNC [s].

    Attributes
    ----------
    trouble : str
        Why the axis is too fast; empty: it is not.
    """

    def __init__(self, settings: DriveSettings, period: float) -> None:
        self._settings = settings
        self._period = period
        # The commanded speed fades no faster than the axis slows down.
        self._fading = math.exp(-period / max(settings.stop_time, _LONGEST_LAG))
        self.forget()

    def forget(self) -> None:
        """Begin anew: no speed is commanded."""
        self._commanded = 0.0
        self._cycles = 0
        self.trouble = ""

    def command(self, speed: float) -> None:
        """Take the speed that is commanded for the next cycle [m/s or rad/s]."""
        self._commanded = max(self._commanded, speed)

    def judge(self, before: Feedback, at: Feedback, *, powered: bool) -> bool:
        """Return whether the axis may have gone this way between two answers.

        The time is counted in SYNC periods: the most of the SYNCs sent, the answers received, and
        the time between both answers. Answers get lost or come late, and a late SYNC finds the axis
        farther along.
        """
        settings, told = self._settings, self._commanded
        periods = max(
            1,
            at.syncs - before.syncs,
            at.number - before.number,
            round((at.time - before.time) / self._period),
        )
        speed = abs(settings.position(at.position - before.position)) / (periods * self._period)
        bound = _FACTOR * told + _MARGINS[settings.unit]
        self._commanded *= self._fading
        is_fast = powered and speed > bound
        self._cycles = self._cycles + 1 if is_fast else 0
        if self._cycles >= _TOO_FAST and not self.trouble:
            self.trouble = (
                f"moves at {settings.told(speed)}/s, at most {settings.told(bound)}/s where "
                f"{settings.told(told)}/s are commanded"
            )
        return not is_fast
