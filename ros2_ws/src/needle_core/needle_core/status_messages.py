"""device/status and needle/controller_status as dataclasses: their key-values are read only here.

A field is named after its key, which ends in its unit. What a message lacks, and what cannot be
read, keeps the field's default: a status is foreign data.
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
    """A DiagnosticStatus whose keys are the fields of a subclass.

    Attributes
    ----------
    part : str
        Which part of the node it is about.
    source : str
        Full name of the node that says it.
    level : Level
        How bad it is.
    text : str
        One line for a person.
    """

    part: ClassVar[str]
    source: str = ""
    level: Level = Level.OK
    text: str = ""

    @classmethod
    def parse(cls: type[_Kind], values: Mapping[str, str]) -> _Kind:
        """Return what key-values say, of an unnamed node."""
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
        """Return a DiagnosticStatus by its fields."""
        said = {"source": status.source, "level": status.level, "text": status.text}
        return cls(**(vars(cls.parse(status.values)) | said))

    @property
    def values(self) -> dict[str, str]:
        """Key-values, in the order of the fields."""
        return {
            row.name: _text(getattr(self, row.name), row.metadata.get("format", ""))
            for row in fields(self)
            if row.name not in _IN_STATUS
        }

    @property
    def status(self) -> Status:
        """The same as a DiagnosticStatus."""
        return Status(self.source, self.part, self.level, self.text, self.values)

    @property
    def diagnostic(self) -> Diagnostic:
        """The same as a line of health."""
        return Diagnostic(self.level, self.text, self.values)


@dataclass(frozen=True, kw_only=True)
class DeviceStatus(KeyValues):
    """Content of device/status.

    Attributes
    ----------
    state, activity : str
        What the device may do, and what moves (docs/safety.md).
    homed : bool
        Whether both axes are homed.
    hold_owner, press_again : str
        Whose hold counts; who presses without that it counts, and has to release first.
    speed_scale : float
        The owner's share of the nominal speed.
    insertion_m, rotation_rad : float or None
        Where the joints are; None where that is not known.
    fault, reason : str
        Why the state is FAULT or ESTOPPED; why the device last stopped, refused or waits.
    needle_out_confirmed : bool
        Whether a person said that the needle is out.
    watchdog_trips, commands_refused : int
        How often a hold, tip or reply was too old; how many commands were refused.
    holds_ignored : int
        How many hold messages came late, twice, or from a session that is over.
    command_ns : int
        Stamp of the newest command, whatever became of it; 0: none yet.
    rotation_owed_rad : float
        How far the rotation is behind a needle that a hand pushes too fast for it.
    simulated : bool or None
        Whether no real needle can move; None while that is not known.
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
        """Fault, else reason, else the line for a person."""
        return self.fault or self.reason or self.text


@dataclass(frozen=True, kw_only=True)
class ControllerStatus(KeyValues):
    """Content of needle/controller_status.

    Attributes
    ----------
    state : str
        IDLE, STEERING, WAITING_FOR_TIP, DONE or FAULT.
    starts, step : int or None, int
        How often it was started (None where it does not say); steps done.
    insertion_m : float
        At the last used tip.
    target_offset_m : float or None
        Offset of the target plane.
    target_point_m : tuple of float, or None
        In `rig`; None where the plane is the target.
    obstacles : int
        How many there are.
    reachable, reachable_depth_m : bool or None, float or None
        Whether plane or point can be reached, and the least depth that any law needs for it.
    trusted : str
        "trusted", "doubtful: " and why, or empty.
    r1_low_m, r1_high_m : float or None
        The interval that holds r1 with 95 %.
    reason : str
        Why the state is what it is, or what is amiss.
    awaiting : str
        What the next action needs: nothing, hold, tip, device or result.
    insertion : str
        stepwise or continuous.
    command_ns, tip_after_ns : int
        Stamp of the newest command; a tip that was exposed after this is wanted.
    tips_rejected, tips_rejected_for : int, str
        How many tips were refused, and why.
    watchdog_trips : int
        How often the steady clock, not data, decided.
    preset : str
        Estimator and law.
    depth_m : float or None
        Where steering ends.
    heard : str
        What was heard since the status before, in order (`received_messages`).
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


def _number(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is no finite number")
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


# Kind of status to its keys, each with what reads its value.
_KEYS: dict[type[KeyValues], list[tuple[str, Callable[[str], Any]]]] = {
    kind: _keys(kind) for kind in (DeviceStatus, ControllerStatus)
}
