"""Rule `axis_speed`: an axis goes no faster than it was told."""

from __future__ import annotations

import math

from needle_device_driver.cia402.drive_monitor import Feedback
from needle_device_driver.cia402.drive_settings import DriveSettings

# Of the commanded speed, to which the axis' own margin comes [m/s], [rad/s].
_FACTOR = 1.5
_MARGINS = {"m": 5e-4, "rad": 0.1}
# In answered cycles that are too fast one after the other: a drive that goes to 0 at its home makes
# one of them.
_TOO_FAST = 2
# A motor that lags behind its set-points goes on after them [s].
_LONGEST_LAG = 0.2


class SpeedWatch:
    """Compares the speed of an axis with the speed that was last commanded.

    Parameters
    ----------
    settings : DriveSettings
        The axis' drive.
    period : float
        Of the SYNC [s].

    Attributes
    ----------
    trouble : str
        How the axis was too fast; empty: it was not.
    """

    def __init__(self, settings: DriveSettings, period: float) -> None:
        self._settings = settings
        self._period = period
        # A drive slows down on its ramp, and the motor behind it.
        self._fading = math.exp(-period / max(settings.stop_time, _LONGEST_LAG))
        self.forget()

    def forget(self) -> None:
        """Begin anew with an axis that was commanded nothing."""
        self._commanded = 0.0
        self._cycles = 0
        self.trouble = ""

    def command(self, speed: float) -> None:
        """Take a speed that is commanded for the next cycle [m/s or rad/s]."""
        self._commanded = max(self._commanded, speed)

    def judge(self, before: Feedback, at: Feedback, *, powered: bool) -> bool:
        """Return whether the way between two answers is one that the axis may have gone.

        Its time is the number of SYNC periods, by whichever of SYNCs, answers and arrival says
        most: answers may be lost, or late, and a late SYNC finds the axis farther on.
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
