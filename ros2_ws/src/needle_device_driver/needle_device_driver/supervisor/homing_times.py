"""Rule `homing_time`: no axis looks longer for its home switch than its travel takes."""

from __future__ import annotations

from needle_device_driver.axes.axis_pair import PairSnapshot
from needle_device_driver.supervisor.limits import SafetyLimits

# Weight of the time on a switch: a drive leaves it at a quarter of the homing speed.
_OFF_SWITCH = 0.25


class HomingTimes:
    """Counts how long each axis has been looking for its home switch.

    Parameters
    ----------
    limits : SafetyLimits
        They have the longest homings.
    """

    def __init__(self, limits: SafetyLimits) -> None:
        self._longest = limits.longest_homings
        self._times = [0.0, 0.0]

    def count(self, at: PairSnapshot, period: float) -> str:
        """Let `period` [s] go by; return which axis has taken too long, empty: none."""
        for k, (name, axis) in enumerate(at.by_name.items()):
            self._times[k] += period * axis.moving * (_OFF_SWITCH if axis.at_home_switch else 1)
            if self._times[k] > self._longest[k]:
                return f"no home switch of the {name} axis in {self._longest[k]:.0f} s"
        return ""
