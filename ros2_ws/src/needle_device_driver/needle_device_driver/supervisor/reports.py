"""Reports of the motion supervisor: results of commands, notices, results of service calls."""

from __future__ import annotations

import dataclasses
from typing import TypeAlias

from needle_core.messages import CommandResult
from needle_device_driver.rules import Rule

SUCCEEDED = "succeeded"
REPLACED = "replaced"
"""Outcome of a path that a newer one replaced before its end."""
MAX_NOTICES, NOTICE_PERIOD = 5, 1.0


@dataclasses.dataclass(frozen=True)
class Notice:
    """An event for the log.

    Attributes
    ----------
    text : str
        One sentence with value, unit and bound.
    rule : Rule or None
        The safety rule behind it.
    fault : bool
        Whether it led to FAULT or ESTOPPED.
    """

    text: str
    rule: Rule | None = None
    fault: bool = False

    def __str__(self) -> str:
        """Return the sentence with the rule's name."""
        return self.text if self.rule is None else f"{self.text} [{self.rule.value}]"


Event: TypeAlias = CommandResult | Notice


class NoticeLimit:
    """Admits all faults, and `MAX_NOTICES` per rule in `NOTICE_PERIOD`; counts the others."""

    def __init__(self) -> None:
        self._since: dict[Rule | None, float] = {}
        self._count: dict[Rule | None, int] = {}

    def admit(self, notice: Notice, now: float) -> str:
        """Return the text to log for a notice at steady time `now` [s]; empty: none."""
        if notice.fault:
            return str(notice)
        rule = notice.rule
        dropped = 0
        if now - self._since.get(rule, -NOTICE_PERIOD) >= NOTICE_PERIOD:
            dropped = max(self._count.get(rule, 0) - MAX_NOTICES, 0)
            self._since[rule], self._count[rule] = now, 0
        self._count[rule] = self._count.get(rule, 0) + 1
        if self._count[rule] > MAX_NOTICES:
            return ""
        return f"{notice} ({dropped} more not logged)" if dropped else str(notice)


@dataclasses.dataclass(frozen=True)
class ServiceResult:
    """Result of a service call.

    Attributes
    ----------
    success : bool
        Whether the request was executed or begun.
    message : str
        The reason for a refusal, or the action taken.
    """

    success: bool
    message: str
