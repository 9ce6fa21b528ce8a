"""openigtlink as a component: sends the needle and receives targets, in `rig` [mm]."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from needle_bags.live.live_needle import LiveNeedle
from needle_bags.live.needle_inputs import PROPOSALS, needle_inputs, proposed_target
from needle_core import messages as m
from needle_core.component import (
    Actions,
    Component,
    Diagnose,
    Input,
    Log,
    Moment,
    Port,
    Send,
    Timer,
)
from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_core.openigtlink import LinkMessage
from needle_core.settings.parameter_fields import check_fields, fixed_parameter

LINK = "link"
"""Name of the port."""
TIP, ESTIMATE, PLANE = "NeedleTipToRig", "NeedleEstimateToRig", "TargetPlaneToRig"
SHAFT, TARGET, STATUS = "NeedleShaft", "NeedleTarget", "NeedleStatus"
SHAPE, PLAN = "NeedleShape", "NeedlePlan"
_MM = 1e3
# Maximum number of points on the shaft; a viewer draws a line through them.
_MAX_POINTS = 25
# If a planner's entry point is farther from the rig's, the registration is wrong [m].
_ENTRY_TOLERANCE = 2e-3

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class OpenIGTLinkParameters:
    """Parameters of openigtlink."""

    address: str = fixed_parameter(
        "127.0.0.1", "-", "Address to listen on; beyond loopback, its whole network can connect."
    )
    port: int = fixed_parameter(18944, "-", "Port that Slicer connects to; 0: any.", 0, 65535)
    rate: float = fixed_parameter(10.0, "Hz", "Rate of all messages.", 0.5, 30.0)

    def __post_init__(self) -> None:
        """Check the fields; raise a `UserError` like `check_fields`."""
        check_fields(self)


@dataclasses.dataclass(frozen=True)
class Listeners:
    """Number of connected clients, and the problems of their input."""

    count: int
    problems: tuple[str, ...] = ()


class OpenIGTLink(Component):
    """Sends a `LiveNeedle` to the clients of a port, and proposes their targets.

    Parameters
    ----------
    settings : OpenIGTLinkParameters
        The node's parameters.
    """

    name = "openigtlink"
    accepts_simulated_time = True

    def __init__(self, settings: OpenIGTLinkParameters) -> None:
        self.settings = settings
        self._needle = LiveNeedle()
        self._listeners = 0
        path = Input("needle/planned_path", m.Path, self._on_path)
        self.inputs = (*needle_inputs(self._needle), path)
        self.outputs = (PROPOSALS,)
        self.ports = (Port(LINK, self._on_link),)
        self.timers = (Timer(1.0 / settings.rate, self._send),)

    def _on_path(self, message: m.Path, at: Moment) -> Actions:
        self._needle.planned_path = message
        return ()

    def _on_link(self, events: Sequence[Log | Listeners | LinkMessage], at: Moment) -> Actions:
        for event in events:
            match event:
                case Log():
                    yield event
                case Listeners(count, problems):
                    self._listeners = count
                    line = ", ignoring ".join((f"{count} clients", *problems))
                    health = Diagnostic(Level.WARN if problems else Level.OK, line)
                    yield Diagnose("listeners", health)
                case LinkMessage(kind="POINT"):
                    yield from self._on_points(event, at)

    def _on_points(self, message: LinkMessage, at: Moment) -> Actions:
        """Propose the point named target*, and check the one named entry*, of a message.

        Points with other names take their role from the name of the message; two such points are
        entry and target.
        """
        level, line = Level.OK, "ok"
        try:
            points, common = message.points(), _role(message.name)
            roles = [_role(name) or common for name, _ in points]
            if common and len(points) == 2 and not any(_role(name) for name, _ in points):
                roles = ["entry", "target"]
            positions_of: dict[str, m.Vector3] = {}
            for role, (_, position) in zip(roles, points, strict=True):
                if role in positions_of:
                    raise UserError(f"several points named {role}")
                if role:
                    positions_of[role] = position
            distance = math.hypot(*positions_of.get("entry", (0.0,)))
            if not distance <= _ENTRY_TOLERANCE:
                raise UserError(f"the entry is {1e3 * distance:.1f} mm from that of the rig")
            if "target" in positions_of:
                yield proposed_target(positions_of["target"], at.stamp_ns)
        except UserError as error:
            level, line = Level.WARN, f"{message.name}: {error}"
            yield Log("warning", line, "plan")
        yield Diagnose("plan", Diagnostic(level, line))

    def _send(self, at: Moment) -> Actions:
        # Without clients, an empty message makes the port accept new ones.
        yield Send(LINK, (packed(self._needle, at.stamp_ns * 1e-9) if self._listeners else b"",))


def packed(needle: LiveNeedle, now: float) -> bytes:
    """Return all messages about a needle; unknown or outdated quantities are left out.

    Parameters
    ----------
    needle : LiveNeedle
        State of the needle.
    now : float
        Time [s] since 1970; a tip has the time of its exposure.
    """
    # Optional dependency: the rest of this package works without it.
    import pyigtl.messages as igtl  # noqa: PLC0415

    messages: list[Any] = [igtl.StringMessage(_status(needle), now, STATUS)]
    tip, plane, estimate, shape = needle.tip, needle.plane, needle.estimate, needle.shape
    if tip is not None and needle.tip_found:
        messages.append(igtl.TransformMessage(_in_mm(tip.pose), tip.stamp_ns * 1e-9, TIP))
    if estimate is not None:
        messages.append(igtl.TransformMessage(_in_mm(estimate.pose), now, ESTIMATE))
    if plane is not None:
        messages.append(igtl.TransformMessage(_in_mm(plane.T_rig_plane), now, PLANE))
    points = {SHAFT: needle.shaft if needle.tip_found else None, TARGET: needle.target_point}
    for name, positions in points.items():
        if positions is not None:
            at = _thinned(np.atleast_2d(positions)) * _MM
            names = [f"{name}_{number}" for number in range(len(at))]
            messages.append(igtl.PointMessage(at, names, timestamp=now, device_name=name))
    lines: dict[str, tuple[int, Array]] = {}
    if shape is not None:
        lines[SHAPE] = shape[0], shape[1][:, :3, 3]
    plan = needle.planned_path
    if plan is not None and estimate is not None and plan.stamp_ns == estimate.stamp_ns:
        lines[PLAN] = plan.stamp_ns, np.array(plan.positions)
    for name, (stamp_ns, positions) in lines.items():
        line, stamp = np.array([len(positions), *range(len(positions))]), stamp_ns * 1e-9
        messages.append(
            igtl.PolyDataMessage(
                points=positions * _MM, lines=line, timestamp=stamp, device_name=name
            )
        )
    return b"".join(message.pack() for message in messages)


def _role(name: str) -> str:
    """Return `target` or `entry` if a name begins with it, else an empty string."""
    return next((role for role in ("target", "entry") if name.casefold().startswith(role)), "")


def _status(needle: LiveNeedle) -> str:
    if needle.answered_ns is None:
        return "no needle data received"
    return "tip found" if needle.tip_found else "no tip found"


def _in_mm(pose: Array) -> Array:
    pose = pose.copy()
    pose[:3, 3] *= _MM
    return pose


def _thinned(points: Array) -> Array:
    """Return at most `_MAX_POINTS` points, including both ends."""
    count = min(len(points), _MAX_POINTS)
    return np.asarray(points[np.round(np.linspace(0, len(points) - 1, count)).astype(int)])
