"""Inputs and outputs of the step protocol in `steering`, as plain data."""

from __future__ import annotations

import dataclasses
import enum

from needle_controller.protocol.plane_control import ControlUpdate
from needle_core.component import Log


class SteeringState(enum.Enum):
    """The controller's states."""

    IDLE = "IDLE"
    STEERING = "STEERING"
    WAITING_FOR_TIP = "WAITING_FOR_TIP"
    DONE = "DONE"
    FAULT = "FAULT"


class Awaiting(enum.Enum):
    """Input that the next action needs."""

    NOTHING = "nothing"
    HOLD = "hold"
    TIP = "tip"
    DEVICE = "device"
    RESULT = "result"


@dataclasses.dataclass(frozen=True)
class SendStep:
    """Send one trajectory point.

    Attributes
    ----------
    stamp_ns : int
        Stamp of the tip that caused it [ns].
    insertion, rotation : float
        Wanted joints, absolute [m], [rad].
    duration : float
        Time from start [s].
    """

    stamp_ns: int
    insertion: float
    rotation: float
    duration: float


@dataclasses.dataclass(frozen=True)
class SendPath:
    """Send the path ahead, in place of the one under way.

    Attributes
    ----------
    stamp_ns : int
        Stamp of the tip that it was made from or confirmed by [ns].
    points : tuple of tuple of float
        Of each point insertion [m], rotation [rad], time from start [s]; the first is where the
        path begins, at time 0.
    """

    stamp_ns: int
    points: tuple[tuple[float, float, float], ...]


@dataclasses.dataclass(frozen=True)
class PublishUpdate:
    """Publish estimate and control input, stamped with the tip's exposure."""

    stamp_ns: int
    update: ControlUpdate


Action = SendStep | SendPath | PublishUpdate | Log


@dataclasses.dataclass(frozen=True)
class StartReply:
    """Answer to a service call."""

    success: bool
    message: str
