"""Content of needle/controller_status."""

from __future__ import annotations

import math

from needle_controller.protocol.steering import Steering
from needle_controller.protocol.steering_types import SteeringState
from needle_core.diagnostics import Level
from needle_core.status_messages import ControllerStatus

_LEVELS = {SteeringState.FAULT: Level.ERROR, SteeringState.WAITING_FOR_TIP: Level.WARN}


def controller_status(steering: Steering, preset: str, source: str = "") -> ControllerStatus:
    """Return what the node `source` says of the protocol."""
    reach, control, intake = steering.reach, steering.control, steering.intake
    point = control.target_point
    target = None if point is None else (float(point[0]), float(point[1]), float(point[2]))
    reason = steering.patience.silence or steering.reason
    level = _LEVELS.get(steering.state, Level.OK)
    if steering.rejection or steering.patience.silence or steering.trust.is_doubtful:
        level = max(level, Level.WARN)
    return ControllerStatus(
        source=source,
        level=level,
        text=reason or steering.state.value,
        state=steering.state.value,
        starts=steering.starts,
        step=steering.step,
        insertion_m=steering.insertion,
        target_offset_m=control.plane.offset,
        target_point_m=target,
        obstacles=len(control.obstacles),
        reachable=None if reach is None else bool(reach.reachable),
        reachable_depth_m=None if reach is None else float(reach.depth),
        trusted=steering.trust.verdict,
        r1_low_m=_finite(steering.trust.low),
        r1_high_m=_finite(steering.trust.high),
        reason=reason,
        awaiting=steering.awaiting.value,
        insertion=steering.settings.insertion,
        command_ns=steering.command_ns,
        tip_after_ns=intake.after_ns,
        tips_rejected=intake.refused.total(),
        tips_rejected_for=", ".join(
            f"{fault.value} {count}" for fault, count in intake.refused.items()
        ),
        watchdog_trips=steering.watchdog_trips,
        preset=preset,
        depth_m=steering.settings.depth,
    )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
