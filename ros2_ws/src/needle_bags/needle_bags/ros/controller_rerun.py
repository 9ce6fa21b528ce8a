"""Rerun of plane_controller on recorded tips and joints, without a graph."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from needle_bags.reading.bag_messages import SentMessage, messages_as_sent
from needle_bags.rerun.stages import TYPES, Output, Stage
from needle_bags.ros.parameter_snapshots import plain_value
from needle_controller.plane_controller import (
    STATUS,
    TARGET_PLANE,
    TARGET_POINT,
    PlaneController,
)
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.actions import SteeringState
from needle_controller.protocol.joint_history import JointSample, joint_sample
from needle_core.component import Actions, Input, Moment, Publish
from needle_core.convert import from_ros, to_ros
from needle_core.errors import UserError
from needle_core.message_types import to_nanoseconds
from needle_core.messages import JointState
from needle_core.ros.base_node import values_of
from needle_core.status_messages import ControllerStatus

_LONGER_THAN_ANY_TIMEOUT = 1e6
"""[s]"""
_NEVER = Moment(0.0, 0)


class ControllerStage(Stage):
    """Stage that runs the current step protocol, estimator and law on the messages of a bag.

    Joints and results are those of the recorded device, whose commands may have differed. A step
    with a result ends at the recorded joint positions, so that one differing decision does not end
    the comparison. Watchdogs trip where the recorded ones did.

    Parameters
    ----------
    settings : SteeringSettings
        Settings at the start of the run.
    node : str
        Full name of the node in the bag; its parameter changes are applied.
    ends : mapping of int to JointSample
        Joints at the end of each command, by its stamp [ns] (`step_ends`).

    Attributes
    ----------
    tips : int
        Number of tips used so far.
    notes : list of str
        Deviations from the recorded run.
    name : str
        Name of the controller.
    """

    def __init__(
        self, settings: SteeringSettings, node: str, ends: Mapping[int, JointSample]
    ) -> None:
        self._node = node
        self.name = settings.controller
        self._controller = PlaneController(settings)
        self._steering = self._controller.steering
        self._ends = ends
        self._steady = 0.0
        self._recorded_trips = 0
        self._recorded = ControllerStatus()
        self.tips = 0
        self.notes: list[str] = []
        self._rows = {row.topic: row for row in self._controller.inputs}
        self._handlers: dict[str, Callable[[Any, int], Actions]] = {
            **{topic: partial(_deliver, row) for topic, row in self._rows.items()},
            "device/result": self._handle_result,
            TARGET_PLANE: partial(self._handle_target, TARGET_PLANE),
            TARGET_POINT: partial(self._handle_target, TARGET_POINT),
            "needle/controller_status": self._handle_status,
            "/parameter_events": self._handle_parameters,
        }
        self.topics = frozenset(self._handlers)

    def process(self, topic: str, sent: SentMessage, message: Any) -> list[Output]:
        """Process a message of a topic, given by relative name; return the outputs."""
        outputs = []
        for action in self._handlers[topic](message, sent.time):
            if not isinstance(action, Publish) or action.topic == STATUS:
                continue
            self.tips += action.topic == "needle/estimate"
            content = to_ros(action.message, TYPES)
            outputs.append(Output(action.topic, sent.log_time, action.message.stamp_ns, content))
        return outputs

    def _handle_result(self, message: Any, sent_ns: int) -> Actions:
        stamp = to_nanoseconds(message.stamp)
        if (end := self._ends.get(stamp)) is not None:
            self._steering.on_recorded_step(stamp, end)
        return _deliver(self._rows["device/result"], message, sent_ns)

    def _handle_target(self, topic: str, message: Any, sent_ns: int) -> Actions:
        actions = list(_deliver(self._rows[topic], message, sent_ns))
        if complaint := self._controller.problems.get(topic):
            self.notes.append(f"{topic} refused: {complaint}")
        return actions

    def _handle_status(self, message: Any, _: int) -> Actions:
        """Start, stop and time out where the recorded controller did.

        A bag contains neither service calls nor the steady clock.
        """
        before, now = self._recorded, ControllerStatus.parse(values_of(message))
        self._recorded = now
        if now.watchdog_trips > self._recorded_trips:
            self._recorded_trips = now.watchdog_trips
            return self._time_out()
        if now.is_steering and not before.is_steering:
            reply, actions = self._controller.start(_NEVER)
            if not reply.success:
                self.notes.append(f"steering would not start: {reply.message}")
            return actions
        was_stopped = now.state == SteeringState.IDLE.value and now.reason == "stopped"
        if before.is_steering and was_stopped:
            return self._controller.stop(_NEVER)[1]
        return ()

    def _time_out(self) -> Actions:
        begin, self._steady = self._steady, self._steady + _LONGER_THAN_ANY_TIMEOUT
        late = [*self._steering.on_time(begin), *self._steering.on_time(self._steady)]
        return self._controller.carry_out(late, _NEVER)

    def _handle_parameters(self, message: Any, _: int) -> Actions:
        if message.node != self._node:
            return ()
        known = {field.name for field in dataclasses.fields(SteeringSettings)}
        changes: dict[str, Any] = {}
        for parameter in message.changed_parameters:
            if parameter.name in known:
                value = plain_value(parameter.value)
                changes[parameter.name] = tuple(value) if isinstance(value, list) else value
        try:
            settings = dataclasses.replace(self._steering.settings, **changes)
        except UserError as error:
            self.notes.append(f"change of parameters refused: {error}")
            return ()
        if settings != self._steering.settings:
            self._steering.configure(settings)
        return ()


def _deliver(row: Input, message: Any, sent_ns: int) -> Actions:
    """Deliver a recorded message to the controller."""
    return row.handler(from_ros(row.message, message), Moment(0.0, 0, sent_ns))


def step_ends(path: Path, namespace: str) -> dict[int, JointSample]:
    """Return the joints at the end of each command with a result, by its stamp [ns].

    Raises
    ------
    UserError
        If the bag is broken.
    """
    joints, results = namespace + "joint_states", namespace + "device/result"
    ends: dict[int, JointSample] = {}
    answered: list[int] = []
    for sent, message in messages_as_sent(path, {joints, results}.__contains__):
        if sent.topic == results:
            answered.append(to_nanoseconds(message.stamp))
            continue
        with contextlib.suppress(UserError):
            sample = joint_sample(from_ros(JointState, message), sent.time)
            ends.update(dict.fromkeys(answered, sample))
            answered.clear()
    return ends
