"""Reports of the motion supervisor: answers, results, status."""

from __future__ import annotations

import dataclasses
from typing import TypeAlias

from needle_device_driver.rules import Rule

SUCCEEDED = "succeeded"
REPLACED = "replaced"
"""Of a path whose place another took before its end."""


@dataclasses.dataclass(frozen=True)
class StepResult:
    """The end of a step, or of a command that never became one.

    Attributes
    ----------
    stamp_ns : int
        The command's stamp [ns].
    outcome : str
        `succeeded`, `replaced` or `aborted: why`.
    """

    stamp_ns: int
    outcome: str


@dataclasses.dataclass(frozen=True)
class Notice:
    """Something a person should read once in the log.

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


MOST_NOTICES, NOTICE_PERIOD = 5, 1.0


class NoticeLimit:
    """Lets through `MOST_NOTICES` of a rule in `NOTICE_PERIOD`, counts others; faults always."""

    def __init__(self) -> None:
        self._since: dict[Rule | None, float] = {}
        self._count: dict[Rule | None, int] = {}

    def admit(self, notice: Notice, now: float) -> str:
        """Return what to say of a notice at steady time `now` [s]; empty: nothing."""
        if notice.fault:
            return str(notice)
        rule = notice.rule
        left_out = 0
        if now - self._since.get(rule, -NOTICE_PERIOD) >= NOTICE_PERIOD:
            left_out = max(self._count.get(rule, 0) - MOST_NOTICES, 0)
            self._since[rule], self._count[rule] = now, 0
        self._count[rule] = self._count.get(rule, 0) + 1
        if self._count[rule] > MOST_NOTICES:
            return ""
        return f"{notice} ({left_out} more were not told)" if left_out else str(notice)


Event: TypeAlias = StepResult | Notice


@dataclasses.dataclass(frozen=True)
class Reply:
    """The answer to a service.

    Attributes
    ----------
    success : bool
        Whether it was done or begun.
    message : str
        Why not, or what.
    """

    success: bool
    message: str
