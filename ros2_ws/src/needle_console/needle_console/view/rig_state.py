"""Status of device and controller as plain data."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

from needle_core.foreign_text import plain

_LONGEST_TEXT = 200


@dataclasses.dataclass(frozen=True)
class DeviceState:
    """Key-values of `device/status`.

    Attributes
    ----------
    state, activity : str
        As docs/safety.md has them.
    homed, needle_out_confirmed : bool
        Whether both axes are homed; whether a person has said that the needle is out.
    hold_owner, press_again : str
        Whose hold counts; who presses without that it counts, and has to release first.
    trouble : str
        Fault or reason; empty: none.
    simulated : bool
        Whether no real needle can move.
    """

    state: str
    activity: str = "none"
    homed: bool = False
    needle_out_confirmed: bool = False
    hold_owner: str = ""
    press_again: str = ""
    trouble: str = ""
    simulated: bool = False


@dataclasses.dataclass(frozen=True)
class ControllerState:
    """Key-values of `needle/controller_status`; NaN where it says no number.

    Attributes
    ----------
    state, reason, awaiting : str
        Its state, why, and what its next action needs.
    starts : int
        How often it was started.
    depth, target_offset, reachable_depth, r1_low, r1_high : float
        Where steering ends; offset of the target plane; least depth that any law needs; the
        interval that holds r1 with 95 % [m].
    target_point : tuple of float, or None
        In `rig` [m]; None where the plane is the target.
    reachable : bool or None
        Whether plane or point can be reached; None: not known.
    trusted : str
        "trusted", "doubtful: " and why, or empty.
    """

    state: str
    reason: str = ""
    awaiting: str = ""
    starts: int = 0
    depth: float = math.nan
    target_offset: float = math.nan
    target_point: tuple[float, float, float] | None = None
    reachable: bool | None = None
    reachable_depth: float = math.nan
    trusted: str = ""
    r1_low: float = math.nan
    r1_high: float = math.nan


def device_state(values: Mapping[str, str]) -> DeviceState:
    """Return what `device/status` says."""
    return DeviceState(
        state=_text(values, "state"),
        activity=_text(values, "activity"),
        homed=values.get("homed") == "true",
        needle_out_confirmed=values.get("needle_out_confirmed") == "true",
        hold_owner=_text(values, "hold_owner"),
        press_again=_text(values, "press_again"),
        trouble=_text(values, "fault") or _text(values, "reason"),
        simulated=values.get("simulated") == "true",
    )


def controller_state(values: Mapping[str, str]) -> ControllerState:
    """Return what `needle/controller_status` says."""
    point = [_number(part) for part in values.get("target_point_m", "").split(",")]
    has_point = len(point) == 3 and all(map(math.isfinite, point))
    starts = _number(values.get("starts", ""))
    return ControllerState(
        state=_text(values, "state"),
        reason=_text(values, "reason"),
        awaiting=_text(values, "awaiting"),
        starts=int(starts) if math.isfinite(starts) else 0,
        depth=_number(values.get("depth_m", "")),
        target_offset=_number(values.get("target_offset_m", "")),
        target_point=(point[0], point[1], point[2]) if has_point else None,
        reachable={"true": True, "false": False}.get(values.get("reachable", "")),
        reachable_depth=_number(values.get("reachable_depth_m", "")),
        trusted=_text(values, "trusted"),
        r1_low=_number(values.get("r1_low_m", "")),
        r1_high=_number(values.get("r1_high_m", "")),
    )


def _text(values: Mapping[str, str], key: str) -> str:
    return plain(values.get(key, ""), _LONGEST_TEXT)


def _number(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        return math.nan
    return number if math.isfinite(number) else math.nan
