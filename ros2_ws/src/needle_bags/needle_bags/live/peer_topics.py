"""peer_topics as a component: the needle under the topic names and units of other packages."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from needle_bags.live.live_needle import LiveNeedle
from needle_bags.live.needle_inputs import PROPOSALS, needle_inputs, proposed_target, rejecting
from needle_controller.model.target_plane import RIG
from needle_core import messages as m
from needle_core.component import Actions, Component, Input, Moment, Output, Publish, Timer
from needle_core.errors import UserError
from needle_core.files.yaml_files import read_yaml
from needle_core.settings import parameter_fields as fields
from needle_tracker.optics.calibration import pose_matrix, transform_of

Array = npt.NDArray[np.float64]

_UNITS = {"m": 1.0, "mm": 1e3}
_CONTENTS: dict[str, type[Any]] = {
    "shape": m.Poses,
    "tip": m.Pose,
    "base": m.Pose,
    "entry": m.Point,
    "target": m.Point,
    "proposed_target": m.Point,
    "measured_joints": m.JointState,
    "commanded_joints": m.JointState,
}


@dataclasses.dataclass(frozen=True)
class PeerTopicsParameters:
    """Parameters of peer_topics."""

    file: str = fields.fixed_parameter("", "-", "File with the topics; empty: config/peers.yaml.")
    rate: float = fields.fixed_parameter(20.0, "Hz", "Largest rate of each topic.", 0.5, 100.0)

    def __post_init__(self) -> None:
        """Check the fields; raise a `UserError` like `check_fields`."""
        fields.check_fields(self)


@dataclasses.dataclass(frozen=True)
class PeerTopic:
    """Topic published for another package or received from it: a row of the file."""

    topic: str = fields.parameter("", "-", "Name.")
    content: str = fields.parameter("", "-", "What it holds.", choices=tuple(_CONTENTS))
    stamped: bool = fields.parameter(True, "-", "Whether a point is a PointStamped, not a Point.")
    unit: str = fields.parameter("m", "-", "Unit of positions.", choices=tuple(_UNITS))
    frame: str = fields.parameter(RIG, "-", "Frame.")
    translation: tuple[float, ...] = fields.parameter((0.0,) * 3, "m", "Of rig in that frame.")
    rotation: tuple[float, ...] = fields.parameter((0.0, 0.0, 0.0, 1.0), "-", "qx, qy, qz, qw.")

    def __post_init__(self) -> None:
        """Check the fields; raise a `UserError` like `check_fields`."""
        fields.check_fields(self)
        if not self.topic:
            raise UserError("the row has no topic")
        _ = self.T_frame_rig  # checks the numbers

    @functools.cached_property
    def T_frame_rig(self) -> Array:  # noqa: N802
        """Transform from `rig` to the frame of the topic [m]."""
        return transform_of({key: list(getattr(self, key)) for key in ("translation", "rotation")})

    @property
    def message(self) -> type[Any]:
        """Class of its messages."""
        kind = _CONTENTS[self.content]
        return m.BarePoint if kind is m.Point and not self.stamped else kind

    def sent(self, stamp_ns: int, poses: Array) -> Any:
        """Return a message with poses in `rig`, shape (n, 4, 4) [m]."""
        placed = self.T_frame_rig @ poses
        positions = (placed[:, :3, 3] * _UNITS[self.unit]).tolist()
        turns = Rotation.from_matrix(placed[:, :3, :3]).as_quat().tolist()
        pairs = tuple((tuple(at), tuple(turn)) for at, turn in zip(positions, turns, strict=True))
        if self.content == "shape":
            return m.Poses(stamp_ns, self.frame, pairs)
        if self.message is m.Pose:
            return m.Pose(stamp_ns, self.frame, *pairs[0])
        return self.message(*([stamp_ns, self.frame] if self.stamped else []), pairs[0][0])

    def received(self, message: m.Point | m.BarePoint) -> m.Vector3:
        """Return a received point in `rig` [m]; raise a `UserError` if it has another frame."""
        if isinstance(message, m.Point) and message.frame_id not in ("", self.frame):
            raise UserError(f"its frame is '{message.frame_id}', expected '{self.frame}'")
        position = np.array(message.position) / _UNITS[self.unit]
        x, y, z = (self.T_frame_rig[:3, :3].T @ (position - self.T_frame_rig[:3, 3])).tolist()
        return (x, y, z)


def read_peer_topics(path: Path) -> tuple[PeerTopic, ...]:
    """Return the topics of a file; raise a `UserError` that names an invalid row."""
    content = read_yaml(path)
    if not isinstance(content, list) or not all(isinstance(row, dict) for row in content):
        raise UserError(f"{path}: expected a list of {{topic: ..., content: ..., ...}}")
    rows = tuple(
        fields.from_values(PeerTopic, row, f"{path}: {row.get('topic')}") for row in content
    )
    names = [row.topic for row in rows]
    # A topic used in both directions would propose the rig's own target.
    if twice := [name for name in names if names.count(name) > 1]:
        raise UserError(f"{path}: {twice[0]} is listed twice")
    return rows


class PeerTopics(Component):
    """Publishes a `LiveNeedle` as a table specifies, and proposes the targets of other packages.

    A message is published once per stamp of its source, because a subscriber that differentiates
    it must not receive duplicates.

    Parameters
    ----------
    settings : PeerTopicsParameters
        The node's parameters.
    table : tuple of PeerTopic
        The topics; those with proposed targets are received, the others published.
    """

    name = "peer_topics"
    accepts_simulated_time = True

    def __init__(self, settings: PeerTopicsParameters, table: tuple[PeerTopic, ...]) -> None:
        received = [row for row in table if row.content == "proposed_target"]
        self.settings, self._published = settings, [row for row in table if row not in received]
        self._needle = LiveNeedle()
        self._command = m.JointState(0, (), ())
        self._stamps: dict[str, int] = {}
        self.inputs = (
            *needle_inputs(self._needle),
            Input("device/joint_trajectory", m.Trajectory, self._on_command),
            *(
                rejecting(Input(row.topic, row.message, functools.partial(self._on_target, row)))
                for row in received
            ),
        )
        self.outputs = (
            *(Output(row.topic, row.message) for row in self._published),
            PROPOSALS,
        )
        self.timers = (Timer(1.0 / settings.rate, self._publish),)

    def _on_command(self, message: m.Trajectory, at: Moment) -> Actions:
        if message.points:
            positions = message.points[-1].positions
            self._command = m.JointState(message.stamp_ns, message.joint_names, positions)
        return ()

    def _on_target(self, row: PeerTopic, message: m.Point | m.BarePoint, at: Moment) -> Actions:
        yield proposed_target(row.received(message), at.stamp_ns)

    def _publish(self, at: Moment) -> Actions:
        for row in self._published:
            if row.message is m.JointState:
                is_measured = row.content == "measured_joints"
                joints = self._needle.joints if is_measured else self._command
                named = dataclasses.replace(joints, frame_id=row.frame)
                message = named if joints.names else None
            else:
                poses = self._poses(row.content, at.stamp_ns)
                message = poses and row.sent(*poses)
            stamp_ns = getattr(message, "stamp_ns", at.stamp_ns)
            if message is not None and self._stamps.get(row.topic) != stamp_ns:
                self._stamps[row.topic] = stamp_ns
                yield Publish(row.topic, message)

    def _poses(self, content: str, now: int) -> tuple[int, Array] | None:
        """Return stamp [ns] and poses in `rig`, shape (n, 4, 4) [m]; None if unknown."""
        needle = self._needle
        tip, joints, target = needle.tip, needle.joints, needle.target_point
        match content:
            case "shape":
                return needle.shape
            case "tip" if tip is not None and needle.tip_found:
                return tip.stamp_ns, tip.pose[None]
            case "base" if joints.names:
                positions = dict(zip(joints.names, joints.positions, strict=False))
                turn = Rotation.from_euler("z", positions.get(m.ROTATION_JOINT, 0.0)).as_matrix()
                position = (0.0, 0.0, positions[m.INSERTION_JOINT])
                return joints.stamp_ns, pose_matrix(turn, position)[None]
            case "entry":
                return now, np.eye(4)[None]
            case "target" if target is not None:
                return now, pose_matrix(np.eye(3), target)[None]
        return None
