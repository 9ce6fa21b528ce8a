"""Component `tracked_tip`: transforms of a tracker in, tips with their covariance out."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from needle_core import messages as m
from needle_core.component import (
    JOINT_STATES,
    Actions,
    Component,
    Diagnose,
    Input,
    Log,
    Moment,
    Output,
    Peers,
    Port,
    PortChange,
    Publish,
    Timer,
)
from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_core.openigtlink import LinkStream
from needle_core.rotations import rotation_from_quaternion
from needle_core.settings.parameter_fields import check_fields, fixed_parameter
from needle_tracker.answers.tracker_messages import (
    ROLL_VARIANCE,
    insertion_of,
    tip_message,
    tip_pose_message,
)
from needle_tracker.optics.calibration import pose_matrix
from needle_tracker.sources.pairing import InsertionHistory
from needle_tracker.stereo.triangulation import SpatialTip
from needle_tracker.stereo_tracker import TIP, TIP_POSE
from needle_tracker.tracked.registration import Registration, read_registration
from needle_tracker.tracked.transform_checks import (
    Place,
    PlaceCheck,
    Rejection,
    TrackerTransform,
    check_transform,
)

TRACKER = "tracker"
"""Name of the port; also the part of the diagnostics."""
CLIENT, SERVER, POSE, TRANSFORM = "openigtlink_client", "openigtlink_server", "pose", "transform"
_AXES = {
    "none": np.zeros(3),
    **dict(zip(("x", "y", "z", "-x", "-y", "-z"), (*np.eye(3), *-np.eye(3)), strict=True)),
}
_UNITS = {"mm": 1e-3, "m": 1.0}
_MAX_AGE = 1.0
"""Largest age of a transform or joint state; a longer silence is reported [s]."""
_SPEED_SPAN = 0.1  # time over which the speed is averaged [s]


@dataclasses.dataclass(frozen=True)
class TrackedTipParameters:
    """Parameters of tracked_tip."""

    source: str = fixed_parameter(
        CLIENT,
        "-",
        "openigtlink_client connects to PlusServer, openigtlink_server waits for a client; pose, "
        "transform: topic tracker/pose, tracker/transform.",
        choices=(CLIENT, SERVER, POSE, TRANSFORM),
    )
    address: str = fixed_parameter("127.0.0.1:18944", "-", "HOST:PORT of OpenIGTLink.")
    transform: str = fixed_parameter("NeedleToTracker", "-", "OpenIGTLink: name of the TRANSFORM.")
    unit: str = fixed_parameter("mm", "-", "Unit of translations.", choices=tuple(_UNITS))
    registration_file: str = fixed_parameter("", "-", "File of register_tracker.")
    heading_axis: str = fixed_parameter(
        "z", "-", "Sensor's axis towards the tip; none: no heading.", choices=tuple(_AXES)
    )
    heading_std: float = fixed_parameter(0.01, "rad", "Of the heading at rest.", 1e-4, 0.2)
    latency: float = fixed_parameter(0.0, "s", "From measurement to the stamp.", 0.0, 0.5)
    latency_std: float = fixed_parameter(0.01, "s", "Standard deviation of it.", 0.0, 0.5)
    stamp_on_arrival: bool = fixed_parameter(
        False, "-", "Ignore the sender's stamps, as its clock differs; latency starts at arrival."
    )

    def __post_init__(self) -> None:
        """Check the fields; a field out of its bounds is a `UserError`."""
        check_fields(self)


class TrackedTip(Component):
    """Publishes the tips measured by a tracker; counts rejected transforms by fault.

    Parameters
    ----------
    settings : TrackedTipParameters
        Parameters of the node.
    registration : Registration
        Pose of the tracker in `rig`.
    name : str
        Full name of the node.
    """

    name = "tracked_tip"

    def __init__(
        self, settings: TrackedTipParameters, registration: Registration, name: str = name
    ) -> None:
        self.name, self.settings, self._registration = name, settings, registration
        lever = settings.heading_std * float(np.linalg.norm(registration.tip_offset))
        self._noise = math.hypot(registration.sensor_std, lever)
        self._place_check = PlaceCheck(self._noise)
        self._insertions, self._stream = InsertionHistory(), LinkStream("TRANSFORM")
        self._last: TrackerTransform | None = None
        self._received_at = -math.inf
        self._counts: Counter[str] = Counter()
        self._port_problem = self._second_source = self._other = ""
        rows = {
            POSE: Input("tracker/pose", m.Pose, self._on_topic),
            TRANSFORM: Input("tracker/transform", m.Transform, self._on_topic),
        }
        own = [row for source, row in rows.items() if source == settings.source]
        self.inputs = (Input("joint_states", m.JointState, self._on_joints, JOINT_STATES), *own)
        self.ports = () if own else (Port(TRACKER, self._on_bytes, self._on_port),)
        self.outputs = (Output(TIP, m.Point), Output(TIP_POSE, m.PoseWithCovariance))
        self.timers = (Timer(0.1, self._on_timer),)

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Check for a second source, since the tips of two sources must not be mixed."""
        names = peers.publishers.get(TIP, ())
        self._second_source = ", ".join(n for n in names if n != self.name.lstrip("/"))
        return ()

    def _measure(self, transform: TrackerTransform, now: float) -> SpatialTip | Rejection:
        """Return the tip of a transform that arrives now [s since 1970], or the rejection."""
        registration, settings = self._registration, self.settings
        if self._second_source:
            return "two_sources", f"{self._second_source} publishes {TIP}, too"
        if rejection := check_transform(transform, self._last, now, _MAX_AGE):
            return rejection
        self._last = transform
        measured_ns, latest = self._measured_ns(transform), self._insertions.latest
        known_ns = min(measured_ns, latest)
        insertion = self._insertions.at(known_ns)
        before = self._insertions.at(known_ns - round(_SPEED_SPAN * 1e9))
        if insertion is None or measured_ns - latest > _MAX_AGE * 1e9:
            return "no_joint_states", f"none within {_MAX_AGE:g} s of the measurement"
        speed = 0.0 if before is None else (insertion - before) / _SPEED_SPAN
        # p = R_rig_tracker (R_tracker_sensor offset + t) + t_rig_tracker
        turn, rotation = registration.T_rig_tracker[:3, :3], transform.matrix[:3, :3]
        tip = rotation @ registration.tip_offset + _UNITS[settings.unit] * transform.matrix[:3, 3]
        position = turn @ tip + registration.T_rig_tracker[:3, 3]
        heading = turn @ rotation @ _AXES[settings.heading_axis]
        turned = settings.heading_std**2 * np.eye(3) + registration.covariance[3:, 3:]
        if settings.heading_axis == "none":
            heading, turned = np.array([0.0, 0.0, 1.0]), ROLL_VARIANCE * np.eye(3)
        if rejection := self._place_check.check(Place(position, heading, insertion)):
            return rejection
        static = self._noise**2 * np.eye(3) + registration.covariance_at(position)
        late = (settings.latency_std * speed) ** 2 * np.outer(heading, heading)
        # A small rotation w changes the heading by w x heading.
        across = np.cross(np.eye(3), heading).T
        return SpatialTip(position, static + late, heading, across @ turned @ across.T)

    def _measured_ns(self, transform: TrackerTransform) -> int:
        return round((transform.stamp - float(self.settings.latency)) * 1e9)

    # ---- inputs -------------------------------------------------------------------------------

    def _on_joints(self, message: m.JointState, at: Moment) -> Actions:
        insertion = insertion_of(message)
        if insertion is not None:
            self._insertions.add(message.stamp_ns, insertion)
        return ()

    def _on_topic(self, message: m.Pose | m.Transform, at: Moment) -> Actions:
        if isinstance(message, m.Pose):
            position, quaternion = message.position, message.orientation
        else:
            position, quaternion = message.translation, message.rotation
        norm = math.hypot(*quaternion)
        # An unset quaternion becomes a matrix that is not a rotation.
        turn = norm * rotation_from_quaternion(np.array(quaternion) / (norm or 1.0))
        matrix = pose_matrix(turn, position)
        return self._on_received(TrackerTransform(message.stamp_ns * 1e-9, matrix), at)

    def _on_bytes(self, batch: Sequence[bytes], at: Moment) -> Actions:
        for message in self._stream.split(b"".join(batch)):
            if message.kind == "TRANSFORM" and message.name == self.settings.transform:
                try:
                    transform = TrackerTransform(message.stamp, *message.transform())
                except UserError as error:
                    yield from self._reject(("unreadable", str(error)), at)
                else:
                    yield from self._on_received(transform, at)
            elif message.kind == "TRANSFORM":
                self._other = message.name
        if self._stream.problem:
            yield from self._reject(("unreadable", self._stream.problem), at)

    def _on_port(self, change: PortChange, at: Moment) -> Actions:
        self._stream = LinkStream("TRANSFORM")
        self._port_problem = change.lost and f"no connection: {change.lost}"
        return ()

    def _on_received(self, transform: TrackerTransform, at: Moment) -> Actions:
        now = at.stamp_ns * 1e-9
        if self.settings.stamp_on_arrival:
            transform = transform._replace(stamp=now)
        tip = self._measure(transform, now)
        if isinstance(tip, tuple):
            yield from self._reject(tip, at)
            return
        self._received_at = at.steady
        stamp_ns = self._measured_ns(transform)
        yield Publish(TIP_POSE, tip_pose_message(tip, stamp_ns))
        yield Publish(TIP, tip_message(tip, stamp_ns))
        self._counts["tips"] += 1
        yield self._diagnose(Level.OK, "tips published")

    # ---- diagnostics --------------------------------------------------------------------------

    def _on_timer(self, at: Moment) -> Actions:
        if at.steady - self._received_at > _MAX_AGE:
            silence = f"no {self.settings.transform} for {_MAX_AGE:g} s"
            silence += f", but {self._other}" if self._other else ""
            yield self._diagnose(Level.WARN, self._port_problem or silence)

    def _reject(self, rejection: Rejection, at: Moment) -> Actions:
        self._received_at = at.steady
        fault, text = rejection
        self._counts[fault] += 1
        yield Log("warning", f"no tip: {fault}: {text}", fault)
        yield self._diagnose(Level.WARN, f"no tip: {fault}", text)

    def _diagnose(self, level: Level, message: str, text: str = "") -> Diagnose:
        values = {name: str(count) for name, count in sorted(self._counts.items())}
        return Diagnose(TRACKER, Diagnostic(level, message, {**values, "reason": text}))


def make_tracked_tip(settings: TrackedTipParameters, name: str = TrackedTip.name) -> TrackedTip:
    """Return the component with the registration of its settings; raises a UserError without it."""
    if not settings.registration_file:
        raise UserError("registration_file is not set; register_tracker writes one")
    return TrackedTip(settings, read_registration(Path(settings.registration_file)), name)
