"""Content of needle/controller_status."""

from __future__ import annotations

import math

from needle_controller.protocol.steering import Steering
from needle_controller.protocol.steering_types import SteeringState
from needle_core.diagnostics import Diagnostic, Level

_LEVELS = {SteeringState.FAULT: Level.ERROR, SteeringState.WAITING_FOR_TIP: Level.WARN}


def steering_diagnostic(steering: Steering, preset: str) -> Diagnostic:
    """Return needle/controller_status as a line of health."""
    reachable, reachable_depth = "", ""
    if steering.reach is not None:
        reachable = str(bool(steering.reach.reachable)).lower()
        reachable_depth = repr(float(steering.reach.depth))
    point = steering.control.target_point
    values = {
        "state": steering.state.value,
        "starts": str(steering.starts),
        "step": str(steering.step),
        "insertion_m": repr(steering.insertion),
        "target_offset_m": repr(steering.control.plane.offset),
        "target_point_m": "" if point is None else ", ".join(repr(float(c)) for c in point),
        "obstacles": str(len(steering.control.obstacles)),
        "reachable": reachable,
        "reachable_depth_m": reachable_depth,
        "trusted": steering.trust.verdict,
        "r1_low_m": _text(steering.trust.low),
        "r1_high_m": _text(steering.trust.high),
        "reason": steering.patience.silence or steering.reason,
        "awaiting": steering.awaiting.value,
        "insertion": steering.settings.insertion,
        "command_ns": str(steering.command_ns),
        "tip_after_ns": str(steering.intake.after_ns),
        "tips_rejected": str(steering.intake.refused.total()),
        "tips_rejected_for": ", ".join(
            f"{fault.value} {count}" for fault, count in steering.intake.refused.items()
        ),
        "watchdog_trips": str(steering.watchdog_trips),
        "preset": preset,
        "depth_m": repr(steering.settings.depth),
    }
    level = _LEVELS.get(steering.state, Level.OK)
    if steering.rejection or steering.patience.silence or steering.trust.is_doubtful:
        level = max(level, Level.WARN)
    return Diagnostic(level, values["reason"] or steering.state.value, values)


def _text(value: float) -> str:
    """Return a number's text, empty for none."""
    return repr(value) if math.isfinite(value) else ""
