"""Recorded tips and joints through what plane_controller does, without the node or a graph."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from needle_analysis.rerun.bag_pass import Output, stored
from needle_bags.reading.bag_order import SentMessage, messages_as_sent
from needle_bags.ros.parameter_snapshots import plain_value
from needle_common.errors import UserError
from needle_common.ros.conversions import to_nanoseconds, values_of
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.steering_types import Action, Log, PublishUpdate, SteeringState
from needle_controller.ros.conversions import TARGET_PLANE, TARGET_POINT, to_joint_sample
from needle_controller.ros.steering_messages import SteeringMessages, output_messages

_STEERING = (SteeringState.STEERING.value, SteeringState.WAITING_FOR_TIP.value)
_LONGER_THAN_ANY_TIMEOUT = 1e6
"""[s]"""


class ControllerStage:
    """Today's step protocol, estimator and law on a bag's messages.

    The device is the recorded one: its joints and answers are those to other commands, maybe, and
    a step that is answered led where the joints say; so one other decision does not end the
    comparison. Watchdogs run out where the recorded ones did.

    Parameters
    ----------
    settings : SteeringSettings
        The node's, as the run began.
    node : str
        The node's full name in the bag, whose changes of parameters are taken over.
    ends : mapping of int to JointSample
        Stamp of a command [ns] to where it led (`step_ends`).

    Attributes
    ----------
    tips : int
        Tips used so far.
    notes : list of str
        What could not be done as recorded.
    name : str
        What steers, in words.
    """

    def __init__(
        self, settings: SteeringSettings, node: str, ends: Mapping[int, JointSample]
    ) -> None:
        self._node = node
        self.name = settings.controller
        self._messages = SteeringMessages(settings)
        self._steering = self._messages.steering
        self._ends = ends
        self._steady = 0.0
        self._recorded_trips = 0
        self._recorded_state = ""
        self.tips = 0
        self.notes: list[str] = []
        self._takers: dict[str, Callable[[Any, int], Iterable[Action]]] = {
            **{topic: row.take for topic, row in self._messages.inputs.items()},
            "device/result": self._take_result,
            TARGET_PLANE: self._take_plane,
            TARGET_POINT: self._take_point,
            "needle/controller_status": self._take_status,
            "/parameter_events": self._take_parameters,
        }

    @property
    def topics(self) -> frozenset[str]:
        """Relative names of what it takes, and one absolute."""
        return frozenset(self._takers)

    def take(self, topic: str, sent: SentMessage, message: Any) -> list[Output]:
        """Take a message of a topic, by its relative name; return what it led to."""
        outputs = []
        for action in self._takers[topic](message, sent.time):
            if isinstance(action, Log):
                continue
            self.tips += isinstance(action, PublishUpdate)
            outputs += [
                Output(name, sent.log_time, action.stamp_ns, stored(content))
                for name, content in output_messages(action)
            ]
        return outputs

    def _take_result(self, message: Any, sent_ns: int) -> Iterable[Action]:
        stamp = to_nanoseconds(message.stamp)
        if (end := self._ends.get(stamp)) is not None:
            self._steering.on_recorded_step(stamp, end)
        return self._messages.inputs["device/result"].take(message, sent_ns)

    def _take_plane(self, message: Any, sent_ns: int) -> Iterable[Action]:
        actions = self._messages.inputs[TARGET_PLANE].take(message, sent_ns)
        if self._messages.plane_complaint:
            self.notes.append(f"target_plane refused: {self._messages.plane_complaint}")
        return actions

    def _take_point(self, message: Any, sent_ns: int) -> Iterable[Action]:
        actions = self._messages.inputs[TARGET_POINT].take(message, sent_ns)
        if self._messages.point_complaint:
            self.notes.append(f"target_point refused: {self._messages.point_complaint}")
        return actions

    def _take_status(self, message: Any, _: int) -> Iterable[Action]:
        """Start, stop and lose patience where the recorded controller did.

        Calls of services and the steady clock are in no bag.
        """
        values = values_of(message)
        before, now = self._recorded_state, values.get("state", "")
        self._recorded_state = now
        trips = values.get("watchdog_trips", "")
        if trips.isdecimal() and int(trips) > self._recorded_trips:
            self._recorded_trips = int(trips)
            return self._wait_too_long()
        if now in _STEERING and before not in _STEERING:
            reply, actions = self._steering.on_start()
            if not reply.success:
                self.notes.append(f"would not have started: {reply.message}")
            return actions
        if (
            before in _STEERING
            and now == SteeringState.IDLE.value
            and values.get("reason") == "stopped"
        ):
            return self._steering.on_stop()[1]
        return ()

    def _wait_too_long(self) -> list[Action]:
        begin, self._steady = self._steady, self._steady + _LONGER_THAN_ANY_TIMEOUT
        return [*self._steering.on_time(begin), *self._steering.on_time(self._steady)]

    def _take_parameters(self, message: Any, _: int) -> Iterable[Action]:
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


def step_ends(path: Path, namespace: str) -> dict[int, JointSample]:
    """Return where each command led that was answered: the joints sent next, by its stamp [ns].

    Raises
    ------
    UserError
        If the bag is broken.
    """
    joints, results = namespace + "joint_states", namespace + "device/result"
    ends: dict[int, JointSample] = {}
    answered: list[int] = []
    for sent, message in messages_as_sent(path, {joints, results}.__contains__, lambda _: False):
        if sent.topic == results:
            answered.append(to_nanoseconds(message.stamp))
            continue
        with contextlib.suppress(UserError):
            sample = to_joint_sample(message, sent.time)
            ends.update(dict.fromkeys(answered, sample))
            answered.clear()
    return ends
