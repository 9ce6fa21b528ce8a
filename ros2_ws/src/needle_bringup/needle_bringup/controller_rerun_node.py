"""Recorded tips and joints through what plane_controller does, without the node or a graph."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

from needle_bringup.parameters import plain_value
from needle_bringup.rerun import Output, stored
from needle_common.conversions import to_nanoseconds, values_of
from needle_common.errors import UserError
from needle_controller import conversions
from needle_controller.joint_history import JointSample
from needle_controller.parameters import PlaneControllerParameters
from needle_controller.steering_types import Action, PublishUpdate, SendStep, State

_STEERING = (State.STEERING.value, State.WAITING_FOR_TIP.value)


class ControllerStage:
    """Today's step protocol, estimator and law on a bag's messages.

    The device is the recorded one: its answer to a step counts as the answer to whatever step is
    under way, so that one other decision does not end the comparison. Watchdogs do not run: they
    live on time, and a bag has none.

    Parameters
    ----------
    parameters : PlaneControllerParameters
        The node's, as the run began.
    node : str
        The node's full name in the bag, whose changes of parameters are taken over.
    unheard : frozenset of int
        Stamps of tips that came while no tip was wanted (`bag_hearing.unheard_tips`) [ns].

    Attributes
    ----------
    tips : int
        Tips used so far.
    notes : list of str
        What could not be done as recorded.
    """

    def __init__(
        self, parameters: PlaneControllerParameters, node: str, unheard: frozenset[int]
    ) -> None:
        self._parameters = parameters
        self._node = node
        self._unheard = unheard
        self._steering = parameters.make_steering()
        self._steering.trusts_device = True
        self._sent: int | None = None
        self._recorded_state = ""
        self.tips = 0
        self.notes: list[str] = []
        self._takers: dict[str, Callable[[Any], Iterable[Action]]] = {
            "joint_states": self._take_joints,
            "needle/tip": self._take_tip,
            "needle/tip_pose": lambda m: self._steering.on_tip_pose(
                conversions.to_tip_covariance(m)
            ),
            "device/result": self._take_result,
            "device/status": lambda m: self._steering.on_device(conversions.to_device_status(m)),
            "target_plane": self._take_plane,
            "needle/controller_status": self._take_status,
            "/parameter_events": self._take_parameters,
        }

    @property
    def topics(self) -> frozenset[str]:
        """Relative names of what it takes, and one absolute."""
        return frozenset(self._takers)

    def take(self, topic: str, log_time: int, message: Any) -> list[Output]:
        """Take a message received at `log_time` [ns]; return what it led to."""
        outputs = []
        for action in self._takers[topic](message):
            stamp, messages = 0, {}
            if isinstance(action, SendStep):
                stamp = self._sent = action.stamp_ns
                messages = {"device/joint_trajectory": conversions.to_trajectory(action)}
            elif isinstance(action, PublishUpdate):
                self.tips += 1
                stamp = action.stamp_ns
                messages = _messages(action)
            outputs += [
                Output(name, log_time, stamp, stored(content)) for name, content in messages.items()
            ]
        return outputs

    def _take_joints(self, message: Any) -> Iterable[Action]:
        try:
            sample = conversions.to_joint_sample(message)
        except UserError:
            return ()
        # rclpy gives plain floats where rosbags gives numpy's.
        insertion, rotation = float(sample.insertion), float(sample.rotation)
        return self._steering.on_joints(JointSample(sample.stamp_ns, insertion, rotation))

    def _take_tip(self, message: Any) -> Iterable[Action]:
        tip = conversions.to_tip(message)
        return () if tip.stamp_ns in self._unheard else self._steering.on_tip(tip)

    def _take_result(self, message: Any) -> Iterable[Action]:
        stamp = to_nanoseconds(message.stamp) if self._sent is None else self._sent
        self._sent = None
        return self._steering.on_result(stamp, message.frame_id)

    def _take_plane(self, message: Any) -> Iterable[Action]:
        try:
            plane = conversions.to_plane(message)
            self._parameters.check_plane(plane)
        except UserError as error:
            self.notes.append(f"target_plane refused: {error}")
            return ()
        self._steering.control.plane = plane
        return ()

    def _take_status(self, message: Any) -> Iterable[Action]:
        """Start and stop where the recorded controller did: calls of services are in no bag."""
        values = values_of(message)
        before, now = self._recorded_state, values.get("state", "")
        self._recorded_state = now
        if now in _STEERING and before not in _STEERING:
            reply, actions = self._steering.on_start()
            if not reply.success:
                self.notes.append(f"would not have started: {reply.message}")
            return actions
        if before in _STEERING and now == State.IDLE.value and values.get("reason") == "stopped":
            return self._steering.on_stop()[1]
        return ()

    def _take_parameters(self, message: Any) -> Iterable[Action]:
        if message.node != self._node:
            return ()
        known = {field.name for field in dataclasses.fields(self._parameters)}
        changes: dict[str, Any] = {}
        for parameter in message.changed_parameters:
            if parameter.name in known:
                value = plain_value(parameter.value)
                changes[parameter.name] = tuple(value) if isinstance(value, list) else value
        try:
            values = dataclasses.replace(self._parameters, **changes)
        except UserError as error:
            self.notes.append(f"change of parameters refused: {error}")
            return ()
        if values != self._parameters:
            values.change_steering(self._steering, self._parameters)
            self._parameters = values
        return ()


def _messages(action: PublishUpdate) -> dict[str, Any]:
    update, stamp, estimate = action.update, action.stamp_ns, action.update.estimate
    return {
        "needle/estimate": conversions.to_pose(estimate, stamp),
        "needle/reduced_state": conversions.to_vector(estimate.reduced, stamp),
        "needle/linearized_state": conversions.to_vector(estimate.linearized, stamp),
        "needle/control_input": conversions.to_control_input(update, stamp),
    }
