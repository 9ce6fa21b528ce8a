"""plane_controller as a component: receives measured tips, sends insertion steps."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np

from needle_controller.controller_status import controller_status
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import angle_axes
from needle_controller.model.target_plane import RIG, plane_from_pose, point_from_message
from needle_controller.observers.estimator import Estimate
from needle_controller.planning.obstacles import obstacles_from_markers
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.actions import Action, PublishUpdate, SendPath, SendStep, StartReply
from needle_controller.protocol.continuous import make_steering
from needle_controller.protocol.joint_history import joint_sample
from needle_controller.protocol.steering import Steering
from needle_controller.protocol.tip_checks import Heading, TipCovariance
from needle_core import messages as m
from needle_core.component import (
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    Actions,
    Component,
    Delivery,
    Diagnose,
    Input,
    Log,
    Moment,
    Output,
    Peers,
    Publish,
    Reply,
    Service,
    Timer,
)
from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_core.rotations import quaternion_from_rotation, rotation_from_quaternion
from needle_core.status_messages import ControllerStatus, DeviceStatus

Handler = Callable[[Any, Moment], Iterable[Action]]
COMMANDS, STATUS = "device/joint_trajectory", "needle/controller_status"
TARGET_PLANE, TARGET_POINT, OBSTACLES = "target_plane", "target_point", "obstacles"
PROPOSED_TARGET, PLANNED_PATH = "needle/proposed_target", "needle/planned_path"
_NO_DRIVERS = ("recorder", "peer_topics")
_TARGETS = (TARGET_PLANE, TARGET_POINT, OBSTACLES)
_CHECKED = ("joint_states", *_TARGETS, PROPOSED_TARGET)
_LOG_PERIOD = 2.0
"""Shortest time between two log messages of one kind [s]."""
_MOST_RECEIVED = 100
"""Number of received messages that are published at once: one or two seconds of a rig at rest."""
_UNKNOWN_HEADING = 0.25
"""Variance of a heading above which it counts as not measured [rad^2]."""


class PlaneController(Component):
    """Steers the needle into the target plane, or to the target point.

    Parameters
    ----------
    settings : SteeringSettings
        Parameters of the node.
    name : str
        Full name of the node.

    Attributes
    ----------
    steering : Steering
        The step protocol.
    problems : dict of str to str
        Problem with the latest message of each topic that has one.
    """

    name = "plane_controller"

    def __init__(self, settings: SteeringSettings, name: str = name) -> None:
        self.name, self.settings = name, settings
        self.steering: Steering = make_steering(settings)
        self.problems: dict[str, str] = {}
        self._proposal: m.Point | None = None
        self._bad_joints = 0
        self._has_driver = False
        self._received: list[str] = []
        self._logged: dict[str, float] = {}
        self._reported_health: tuple[dict[str, str], dict[str, str]] | None = None
        self._published: ControllerStatus | None = None
        rows: tuple[tuple[str, type[Any], Handler, Delivery], ...] = (
            ("joint_states", m.JointState, self._on_joints, JOINT_STATES),
            ("device/status", DeviceStatus, self._on_device, LATCHED),
            ("device/result", m.CommandResult, self._on_result, RELIABLE),
            ("needle/tip", m.Point, self._on_tip, RELIABLE),
            ("needle/tip_pose", m.PoseWithCovariance, self._on_tip_pose, RELIABLE),
            (TARGET_PLANE, m.Pose, self._on_plane, LATCHED),
            (TARGET_POINT, m.Point, self._on_point, LATCHED),
            (OBSTACLES, m.Markers, self._on_obstacles, LATCHED),
            (PROPOSED_TARGET, m.Point, self._on_proposal, RELIABLE),
        )
        self.inputs = tuple(
            Input(topic, message, partial(self._receive, topic, handler), delivery)
            for topic, message, handler, delivery in rows
        )
        self.outputs = (
            Output(COMMANDS, m.Trajectory),
            Output("needle/estimate", m.PoseWithCovariance),
            Output("needle/reduced_state", m.Vector),
            Output("needle/linearized_state", m.Vector),
            Output("needle/control_input", m.Vector),
            Output(PLANNED_PATH, m.Path),
            Output(STATUS, ControllerStatus, LATCHED),
            Output(TARGET_POINT, m.Point, LATCHED),
        )
        self.services = (
            Service("plane_controller/start", self._on_start),
            Service("plane_controller/stop", self._on_stop_request),
            Service("plane_controller/accept_target", self._on_accept),
        )
        self.timers = (Timer(0.1, self._on_timer),)

    def on_settings(self, settings: SteeringSettings, at: Moment) -> Actions:
        """Apply changed parameters."""
        self.settings = settings
        self.steering.configure(settings)
        return self.carry_out([Log("info", "parameters changed")], at)

    def carry_out(self, actions: Iterable[Action], at: Moment) -> Actions:
        """Convert actions of the protocol into messages; publish the status if it has changed."""
        for action in actions:
            match action:
                case Log():
                    yield from self._log(action, at)
                case PublishUpdate():
                    yield from _update(action)
                case SendStep() | SendPath():
                    yield Publish(COMMANDS, trajectory(action))
        yield from self._report_changes()

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Check that a driver subscribes to commands: without one, the first step would be lost."""
        names = peers.subscribers.get(COMMANDS, ())
        self._has_driver = any(name.rpartition("/")[2] not in _NO_DRIVERS for name in names)
        return ()

    def _receive(self, topic: str, handler: Handler, message: Any, at: Moment) -> Actions:
        self._received.append(f"{topic} {at.sent_ns}")
        try:
            actions = handler(message, at)
        except UserError as error:
            actions = self._on_bad_message(topic, error)
        else:
            self.problems.pop(topic, None)
        return self.carry_out(actions, at)

    def _on_bad_message(self, topic: str, error: UserError) -> list[Action]:
        self._bad_joints += topic == "joint_states"
        kept = "; the last valid one stays" if topic in _TARGETS else ""
        self.problems[topic] = f"{error}{kept}"
        return [Log("warning", self.problems[topic], topic)]

    def _on_joints(self, message: m.JointState, at: Moment) -> Iterable[Action]:
        return self.steering.on_joints(joint_sample(message, at.sent_ns))

    def _on_device(self, message: DeviceStatus, at: Moment) -> Iterable[Action]:
        return self.steering.on_device(message)

    def _on_result(self, message: m.CommandResult, at: Moment) -> Iterable[Action]:
        return self.steering.on_result(message.stamp_ns, message.outcome, at.sent_ns)

    def _on_tip(self, message: m.Point, at: Moment) -> Iterable[Action]:
        return self.steering.on_tip(message)

    def _on_tip_pose(self, message: m.PoseWithCovariance, at: Moment) -> Iterable[Action]:
        heading = measured_heading(message) if self.settings.measured_heading else None
        return self.steering.on_tip_pose(tip_covariance(message, heading))

    def _on_plane(self, message: m.Pose, at: Moment) -> Iterable[Action]:
        plane = plane_from_pose(message.frame_id, message.position, message.orientation)
        self.steering.settings.check_plane(plane)
        self.steering.control.plane = plane
        self.steering.control.target_point = None
        return [Log("info", f"{TARGET_PLANE} at offset {plane.offset:g} m")]

    def _on_point(self, message: m.Point, at: Moment) -> Iterable[Action]:
        point = self._checked_point(message)
        if message.stamp_ns:
            self.steering.control.observe_target_point(point, message.stamp_ns * 1e-9)
        else:
            # Placed by hand: the time of the position is unknown.
            self.steering.control.target_point = point
        return [Log("info", f"{TARGET_POINT} at {_text(point)}", TARGET_POINT)]

    def _on_proposal(self, message: m.Point, at: Moment) -> Iterable[Action]:
        # A rejected proposal withdraws the previous one, which the planner no longer proposes.
        before, self._proposal = self._proposal, None
        point = self._checked_point(message)
        self._proposal = dataclasses.replace(message, stamp_ns=0)
        if self._proposal == before:
            return []
        text = f"proposed target at {_text(point)}: plane_controller/accept_target applies it"
        return [Log("info", text, PROPOSED_TARGET)]

    def _checked_point(self, message: m.Point) -> Array:
        point = point_from_message(TARGET_POINT, message.frame_id, message.position)
        self.steering.settings.check_point(point)
        return point

    def _on_obstacles(self, message: m.Markers, at: Moment) -> Iterable[Action]:
        obstacles = self.steering.control.obstacles = obstacles_from_markers(message)
        return [Log("info", f"{len(obstacles)} obstacles", OBSTACLES)]

    def start(self, at: Moment) -> tuple[StartReply, Actions]:
        """Start steering, if all conditions hold."""
        reply, actions = self.steering.on_start()
        return reply, self.carry_out(actions, at)

    def stop(self, at: Moment) -> tuple[StartReply, Actions]:
        """Stop sending steps."""
        reply, actions = self.steering.on_stop()
        return reply, self.carry_out(actions, at)

    def _on_start(self, _: bool | None, number: int, at: Moment) -> Actions:
        if self._has_driver:
            return _answer(number, *self.start(at))
        return [Reply(number, False, f"waiting for subscriber of {COMMANDS}")]

    def _on_stop_request(self, _: bool | None, number: int, at: Moment) -> Actions:
        return _answer(number, *self.stop(at))

    def _on_accept(self, _: bool | None, number: int, at: Moment) -> Actions:
        """Publish the proposal as the target point, so that a bag records it."""
        if self._proposal is None:
            yield Reply(number, False, f"no target on {PROPOSED_TARGET}")
            return
        try:
            # The settings may have changed since the proposal.
            point = self._checked_point(self._proposal)
        except UserError as error:
            yield Reply(number, False, str(error))
            return
        yield Publish(TARGET_POINT, self._proposal)
        yield Reply(number, True, f"{TARGET_POINT} at {_text(point)}")

    def _on_timer(self, at: Moment) -> Actions:
        return self.carry_out(self.steering.on_time(at.steady), at)

    def _log(self, log: Log, at: Moment) -> Actions:
        if log.kind:
            if at.steady - self._logged.get(log.kind, -_LOG_PERIOD) < _LOG_PERIOD:
                return
            self._logged[log.kind] = at.steady
        yield log

    def _report_changes(self) -> Actions:
        history = self.steering.tips.joints
        problems = {"joint_states": history.problem} | self.problems
        counts = {
            "joint_states_refused": str(self._bad_joints),
            "joint_states_doubted": str(history.rejected),
        }
        if (problems, counts) != self._reported_health:
            self._reported_health = problems, counts
            for topic in _CHECKED:
                values = counts if topic == "joint_states" else {}
                yield Diagnose(topic, _health(problems.get(topic, ""), values))
        status = controller_status(self.steering, self.name)
        if status != self._published or len(self._received) >= _MOST_RECEIVED:
            self._published, received = status, ", ".join(self._received)
            self._received.clear()
            yield Diagnose("steering", status.diagnostic)
            yield Publish(STATUS, dataclasses.replace(status, heard=received))


def _answer(number: int, reply: StartReply, actions: Actions) -> Actions:
    yield from actions
    yield Reply(number, reply.success, reply.message)


def trajectory(command: SendStep | SendPath) -> m.Trajectory:
    """Return the trajectory of a step (one point) or a path (several)."""
    points = tuple(m.TrajectoryPoint((at, turn), time) for at, turn, time in command.points)
    return m.Trajectory(command.stamp_ns, (m.INSERTION_JOINT, m.ROTATION_JOINT), points)


def tip_covariance(message: m.PoseWithCovariance, heading: Heading | None = None) -> TipCovariance:
    """Return the unchecked covariance of a measured tip, and its heading."""
    matrix = np.array(message.covariance).reshape(6, 6)[:3, :3]
    return TipCovariance(message.stamp_ns, message.frame_id, matrix, heading)


def measured_heading(message: m.PoseWithCovariance) -> Heading | None:
    """Return the unchecked z axis of a tip and the variance of its angle; None if unknown."""
    direction = rotation_from_quaternion(message.orientation)[:, 2]
    turn = np.array(message.covariance).reshape(6, 6)[3:, 3:]
    if not np.all(np.isfinite(turn)):
        return None
    # Mean variance of the two rotations perpendicular to the heading.
    variance = 0.5 * float(np.trace(turn) - direction @ turn @ direction)
    return None if variance > _UNKNOWN_HEADING else (direction, variance)


def _text(point: Array) -> str:
    x, y, z = point
    return f"({x:g}, {y:g}, {z:g}) m"


def _health(problem: str, values: dict[str, str]) -> Diagnostic:
    return Diagnostic(Level.WARN if problem else Level.OK, problem or "ok", values)


def _update(action: PublishUpdate) -> Actions:
    stamp_ns, estimate, command = action.stamp_ns, action.update.estimate, action.update.command
    control = (command.virtual_input, command.rotation_rate, action.update.turned)
    yield Publish("needle/estimate", _pose(estimate, stamp_ns))
    yield Publish("needle/reduced_state", _vector(estimate.reduced, stamp_ns))
    yield Publish("needle/linearized_state", _vector(estimate.linearized, stamp_ns))
    yield Publish("needle/control_input", _vector(np.array(control), stamp_ns))
    if action.update.route is not None:
        points = action.update.route.points.tolist()
        yield Publish(PLANNED_PATH, m.Path(stamp_ns, RIG, tuple(map(tuple, points))))


def _pose(estimate: Estimate, stamp_ns: int) -> m.PoseWithCovariance:
    """Return the estimated pose with its covariance about the fixed axes of the frame."""
    turn = np.eye(6)
    turn[3:, 3:] = angle_axes(estimate.coordinates[3:])
    covariance = turn @ estimate.covariance @ turn.T
    x, y, z = (float(c) for c in estimate.position)
    return m.PoseWithCovariance(
        stamp_ns,
        TARGET_PLANE,
        (x, y, z),
        quaternion_from_rotation(estimate.rotation.tolist()),
        tuple(covariance.ravel().tolist()),
    )


def _vector(values: Array, stamp_ns: int) -> m.Vector:
    x, y, z = (float(value) for value in values)
    return m.Vector(stamp_ns, TARGET_PLANE, (x, y, z))
