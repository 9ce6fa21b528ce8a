"""Reports of the motion supervisor: answers, results, status."""

from __future__ import annotations

import dataclasses
from typing import TypeAlias

from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.states import Activity, State

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


@dataclasses.dataclass(frozen=True)
class DeviceStatus:
    """Content of device/status.

    Attributes
    ----------
    state : State
        What the device may do.
    activity : Activity
        What moves.
    homed : bool
        Whether both axes are homed.
    hold_owner : str
        Whose hold counts; empty: nobody's.
    press_again : str
        Who presses without that it counts, and has to release first; empty: nobody.
    speed_scale : float
        The owner's share of the nominal speed.
    insertion, rotation : float or None
        Where the joints are [m], [rad]; None where that is not known.
    fault : str
        Why the state is FAULT or ESTOPPED; else empty.
    reason : str
        Why the device last stopped, refused or waits.
    needle_out_confirmed : bool
        Whether a person said that the needle is out.
    watchdog_trips : int
        How often a hold, tip or reply was too old; a lapse that only pauses is none.
    commands_refused : int
        How many commands were refused.
    holds_ignored : int
        How many hold messages came late, twice, or from a session that is over.
    command_ns : int
        Stamp of the newest command, whatever became of it [ns]; 0: none yet.
    rotation_owed : float
        How far the rotation is behind a needle that a hand pushes too fast for it [rad].
    simulated : bool or None
        Whether no real needle can move; None while that is not known.
    """

    state: State
    activity: Activity
    homed: bool
    hold_owner: str
    press_again: str
    speed_scale: float
    insertion: float | None
    rotation: float | None
    fault: str
    reason: str
    needle_out_confirmed: bool
    watchdog_trips: int
    commands_refused: int
    holds_ignored: int
    command_ns: int
    rotation_owed: float
    simulated: bool | None = None
