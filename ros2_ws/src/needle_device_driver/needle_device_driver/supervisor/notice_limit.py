"""Limit of what the log says of what goes wrong again and again."""

from __future__ import annotations

from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.reports import Notice

MOST = 5
PERIOD = 1.0


class NoticeLimit:
    """Lets through `MOST` notices of a rule in `PERIOD`, and counts the others; faults always."""

    def __init__(self) -> None:
        self._since: dict[Rule | None, float] = {}
        self._count: dict[Rule | None, int] = {}

    def admit(self, notice: Notice, now: float) -> str:
        """Return what to say of a notice at steady time `now` [s]; empty: nothing."""
        if notice.fault:
            return str(notice)
        rule = notice.rule
        left_out = 0
        if now - self._since.get(rule, -PERIOD) >= PERIOD:
            left_out = max(self._count.get(rule, 0) - MOST, 0)
            self._since[rule], self._count[rule] = now, 0
        self._count[rule] = self._count.get(rule, 0) + 1
        if self._count[rule] > MOST:
            return ""
        return f"{notice} ({left_out} more were not told)" if left_out else str(notice)
