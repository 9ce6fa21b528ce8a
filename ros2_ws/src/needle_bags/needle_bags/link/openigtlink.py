"""openigtlink as a component: the needle as OpenIGTLink messages, in `rig` and in mm."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from needle_bags.live.live_needle import LiveNeedle
from needle_bags.live.needle_inputs import needle_inputs
from needle_core.component import Actions, Component, Diagnose, Log, Moment, Port, Send, Timer
from needle_core.diagnostics import Diagnostic, Level
from needle_core.settings.parameter_fields import check_fields, fixed_parameter

LINK = "link"
"""Name of the port."""
TIP, ESTIMATE, PLANE = "NeedleTipToRig", "NeedleEstimateToRig", "TargetPlaneToRig"
SHAFT, TARGET, STATUS = "NeedleShaft", "NeedleTarget", "NeedleStatus"
_MM = 1e3
# A viewer draws a line through the points of the shaft.
_MAX_POINTS = 25

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
        """Check the fields; raises UserError as `check_fields`."""
        check_fields(self)


@dataclasses.dataclass(frozen=True)
class Listeners:
    """Number of connected clients, and of clients turned away so far."""

    count: int
    turned_away: int


class OpenIGTLink(Component):
    """Sends a `LiveNeedle` to the clients of a port.

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
        self.inputs = needle_inputs(self._needle)
        self.ports = (Port(LINK, self._on_link),)
        self.timers = (Timer(1.0 / settings.rate, self._send),)

    def _on_link(self, events: Sequence[Log | Listeners], at: Moment) -> Actions:
        for event in events:
            match event:
                case Log():
                    yield event
                case Listeners(count, turned_away):
                    self._listeners = count
                    keys = {"listeners": str(count), "turned away": str(turned_away)}
                    line = f"{count} listening" if count else "nobody listens"
                    yield Diagnose("listeners", Diagnostic(Level.OK, line, keys))

    def _send(self, at: Moment) -> Actions:
        # Without clients the empty message lets the port accept new ones.
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
    tip, plane, estimate = needle.tip, needle.plane, needle.estimate
    if tip is not None and needle.tip_found:
        rotation = Rotation.from_quat(tip.quaternion).as_matrix()
        transform = _matrix(rotation, tip.position)
        messages.append(igtl.TransformMessage(transform, tip.stamp_ns * 1e-9, TIP))
    if estimate is not None:
        transform = _matrix(estimate.rotation, estimate.position)
        messages.append(igtl.TransformMessage(transform, now, ESTIMATE))
    if plane is not None:
        transform = _matrix(plane.T_rig_plane[:3, :3], plane.T_rig_plane[:3, 3])
        messages.append(igtl.TransformMessage(transform, now, PLANE))
    points = {SHAFT: needle.shaft if needle.tip_found else None, TARGET: needle.target_point}
    for name, positions in points.items():
        if positions is not None:
            at = _thinned(np.atleast_2d(positions)) * _MM
            names = [f"{name}_{number}" for number in range(len(at))]
            messages.append(igtl.PointMessage(at, names, timestamp=now, device_name=name))
    return b"".join(message.pack() for message in messages)


def _status(needle: LiveNeedle) -> str:
    if needle.answered_ns is None:
        return "no needle data received"
    return "tip found" if needle.tip_found else "no tip found"


def _matrix(rotation: Array, position: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position * _MM
    return matrix


def _thinned(points: Array) -> Array:
    """Return at most `_MAX_POINTS` points, including both ends."""
    count = min(len(points), _MAX_POINTS)
    return np.asarray(points[np.round(np.linspace(0, len(points) - 1, count)).astype(int)])
