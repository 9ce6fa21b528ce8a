"""Content of needle/controller_status, and its log of received messages (`heard`).

A node on a busy machine receives a message some time after it was sent, possibly after later ones;
messages that exceed its queue are lost. With the log, a bag can be replayed in the order of
reception.
"""

from __future__ import annotations

import math
import re

from needle_controller.protocol.actions import SteeringState
from needle_controller.protocol.steering import Steering
from needle_core.diagnostics import Level
from needle_core.status_messages import ControllerStatus

_LEVELS = {SteeringState.FAULT: Level.ERROR, SteeringState.WAITING_FOR_TIP: Level.WARN}
_LOGGED = re.compile(r"(\S+) (\d{1,19})")


def controller_status(steering: Steering, source: str) -> ControllerStatus:
    """Return the status of the protocol; `source` is the node's name."""
    reach, control, tips = steering.reach, steering.control, steering.tips
    confidence = steering.confidence
    point = control.target_point
    target = None if point is None else (float(point[0]), float(point[1]), float(point[2]))
    reason = steering.watchdog.silence or steering.reason
    level = _LEVELS.get(steering.state, Level.OK)
    if steering.rejection or steering.watchdog.silence or confidence.is_doubtful:
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
        reachable=None if reach is None else reach.reachable,
        reachable_depth_m=None if reach is None else reach.depth,
        trusted=confidence.verdict,
        r1_low_m=_finite(confidence.low),
        r1_high_m=_finite(confidence.high),
        reason=reason,
        awaiting=steering.awaiting.value,
        insertion=steering.settings.insertion,
        command_ns=steering.command_ns,
        tip_after_ns=tips.after_ns,
        tips_rejected=tips.rejected.total(),
        tips_rejected_for=", ".join(f"{fault.value} {n}" for fault, n in tips.rejected.items()),
        watchdog_trips=steering.watchdog_trips,
        preset=steering.settings.preset,
        depth_m=steering.settings.depth,
    )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def received_messages(text: str) -> list[tuple[str, int]]:
    """Return topic and time of sending [ns] of each message of a log, such as `tip 5, joints 7`."""
    found = map(_LOGGED.fullmatch, text.split(", "))
    return [(match[1], int(match[2])) for match in found if match is not None]
