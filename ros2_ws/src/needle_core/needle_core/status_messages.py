"""Key-value messages device/status and needle/controller_status as dataclasses.

A field has the name of its key, which ends in the unit. A missing or malformed value leaves the
field's default, because another node may have sent the message.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, TypeVar, get_type_hints

from needle_core.diagnostics import Diagnostic, Level
from needle_core.messages import Status, Vector3

_Kind = TypeVar("_Kind", bound="KeyValues")
_IN_STATUS = ("source", "level", "text")


@dataclass(frozen=True, kw_only=True)
class KeyValues:
    """DiagnosticStatus whose keys are the fields of a subclass.

    Attributes
    ----------
    part : str
        Part of the node that the status describes.
    source : str
        Full name of the node that sent it.
    level : Level
        Severity.
    text : str
        One line for the user.
    """

    part: ClassVar[str]
    source: str = ""
    level: Level = Level.OK
    text: str = ""

    @classmethod
    def parse(cls: type[_Kind], values: Mapping[str, str]) -> _Kind:
        """Return the status in key-value pairs, without the node's name."""
        read: dict[str, Any] = {}
        for key, reader in _KEYS[cls]:
            if key in values:
                try:
                    read[key] = reader(values[key])
                except ValueError:
                    continue
        return cls(**read)

    @classmethod
    def of(cls: type[_Kind], status: Status) -> _Kind:
        """Return the content of a DiagnosticStatus."""
        fixed = {"source": status.source, "level": status.level, "text": status.text}
        return cls(**(vars(cls.parse(status.values)) | fixed))

    @property
    def values(self) -> dict[str, str]:
        """Key-value pairs, in the order of the fields."""
        return {
            row.name: _text(getattr(self, row.name), row.metadata.get("format", ""))
            for row in fields(self)
            if row.name not in _IN_STATUS
        }

    @property
    def status(self) -> Status:
        """The status as a DiagnosticStatus."""
        return Status(self.source, self.part, self.level, self.text, self.values)

    @property
    def diagnostic(self) -> Diagnostic:
        """The status as a diagnostic."""
        return Diagnostic(self.level, self.text, self.values)


@dataclass(frozen=True, kw_only=True)
class DeviceStatus(KeyValues):
    """Content of device/status.

    Attributes
    ----------
    state, activity : str
        State of the device and its current motion (docs/safety.md).
    homed : bool
        Whether both axes are homed.
    hold_owner, press_again : str
        Source of the valid hold; source of an ignored press, which must be released first.
    speed_scale : float
        Share of the nominal speed, set by the hold owner.
    insertion_m, rotation_rad : float or None
        Joint positions; None if unknown.
    fault, reason : str
        Reason of FAULT or ESTOPPED; reason of the last stop, rejection or wait.
    needle_out_confirmed : bool
        Whether the operator has confirmed that the needle is out.
    watchdog_trips, commands_refused : int
        Number of expired holds, tips or replies; number of rejected commands.
    holds_ignored : int
        Number of hold messages that were late, duplicated, or from an old session.
    command_ns : int
        Stamp of the newest command, regardless of its result; 0 before the first.
    rotation_owed_rad : float
        Lag of the rotation behind the insertion while a hand pushes the needle.
    simulated : bool or None
        Whether the device is simulated; None if unknown.
    """

    part = "device"
    state: str = ""
    activity: str = "none"
    homed: bool = False
    hold_owner: str = ""
    press_again: str = ""
    speed_scale: float = field(default=0.0, metadata={"format": ".3g"})
    insertion_m: float | None = None
    rotation_rad: float | None = None
    fault: str = ""
    reason: str = ""
    needle_out_confirmed: bool = False
    watchdog_trips: int = 0
    commands_refused: int = 0
    holds_ignored: int = 0
    command_ns: int = 0
    rotation_owed_rad: float = field(default=0.0, metadata={"format": ".2f"})
    simulated: bool | None = None

    @property
    def why(self) -> str:
        """The fault if there is one, else the reason, else the line for the user."""
        return self.fault or self.reason or self.text

    def is_idle_for(self, owner: str) -> bool:
        """Return whether this owner's hold counts and nothing moves."""
        return self.hold_owner == owner and self.activity == "none"


@dataclass(frozen=True, kw_only=True)
class ControllerStatus(KeyValues):
    """Content of needle/controller_status.

    Attributes
    ----------
    state : str
        IDLE, STEERING, WAITING_FOR_TIP, DONE or FAULT.
    starts, step : int or None, int
        Number of starts (None if missing); number of completed steps.
    insertion_m : float
        Insertion at the last used tip.
    target_offset_m : float or None
        Offset of the target plane.
    target_point_m : tuple of float, or None
        Target point in `rig`; None if the target is a plane.
    obstacles : int
        Number of obstacles.
    reachable, reachable_depth_m : bool or None, float or None
        Whether the target is reachable; smallest depth at which some law can reach it.
    trusted : str
        "trusted", "doubtful: " with the reason, or empty.
    r1_low_m, r1_high_m : float or None
        95 % interval of r1.
    reason : str
        Reason of the state, or a warning.
    awaiting : str
        Input that the next action requires: nothing, hold, tip, device or result.
    insertion : str
        stepwise or continuous.
    command_ns, tip_after_ns : int
        Stamp of the newest command; earliest exposure of the next useful tip.
    tips_rejected, tips_rejected_for : int, str
        Number of rejected tips, and the count for each reason.
    watchdog_trips : int
        Number of expired watchdogs.
    preset : str
        Names of estimator and law.
    depth_m : float or None
        Insertion at which steering ends.
    heard : str
        Messages received since the previous status, in order (`received_messages`).
    """

    part = "steering"
    state: str = ""
    starts: int | None = None
    step: int = 0
    insertion_m: float = 0.0
    target_offset_m: float | None = None
    target_point_m: Vector3 | None = None
    obstacles: int = 0
    reachable: bool | None = None
    reachable_depth_m: float | None = None
    trusted: str = ""
    r1_low_m: float | None = None
    r1_high_m: float | None = None
    reason: str = ""
    awaiting: str = ""
    insertion: str = ""
    command_ns: int = 0
    tip_after_ns: int = 0
    tips_rejected: int = 0
    tips_rejected_for: str = ""
    watchdog_trips: int = 0
    preset: str = ""
    depth_m: float | None = None
    heard: str = ""

    @property
    def is_steering(self) -> bool:
        """Whether the controller sends steps as soon as a hold counts."""
        return self.state in {"STEERING", "WAITING_FOR_TIP"}


def _number(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is not a finite number")
    return number


def _optional(read: Callable[[str], Any]) -> Callable[[str], Any]:
    return lambda text: read(text) if text else None


def _truth(text: str) -> bool:
    return {"true": True, "false": False}.get(text.lower(), False)


def _point(text: str) -> Vector3:
    x, y, z = (_number(part) for part in text.split(","))
    return x, y, z


_READERS: dict[Any, Callable[[str], Any]] = {
    str: str,
    bool: _truth,
    int: int,
    float: _number,
    bool | None: _optional(_truth),
    int | None: _optional(int),
    float | None: _optional(_number),
    Vector3 | None: _optional(_point),
}


def _text(value: Any, form: str) -> str:
    match value:
        case None:
            return ""
        case bool():
            return str(value).lower()
        case float():
            return format(value, form) if form else repr(value)
        case tuple():
            return ", ".join(repr(part) for part in value)
    return str(value)


def _keys(kind: type[KeyValues]) -> list[tuple[str, Callable[[str], Any]]]:
    types = get_type_hints(kind)
    names = (row.name for row in fields(kind) if row.name not in _IN_STATUS)
    return [(name, _READERS[types[name]]) for name in names]


# Keys of each status class, with the parser of each value.
_KEYS: dict[type[KeyValues], list[tuple[str, Callable[[str], Any]]]] = {
    kind: _keys(kind) for kind in (DeviceStatus, ControllerStatus)
}
