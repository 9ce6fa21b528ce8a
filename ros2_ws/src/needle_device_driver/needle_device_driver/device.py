"""Interface of a device: the topics and services of a motion supervisor.

It is the same for real, emulated and simulated axes; a component adds its cycle.
"""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Callable, Sequence

from needle_core import messages as m
from needle_core.component import (
    JOINT_STATES,
    LATCHED,
    Actions,
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
)
from needle_core.process.ros_domain import CONFLICT_HINT
from needle_core.status_messages import DeviceStatus
from needle_device_driver.procedure import Procedure, Running
from needle_device_driver.supervisor.reports import Notice, NoticeLimit, ServiceResult
from needle_device_driver.supervisor.supervisor import MotionSupervisor

COMMANDS, HOLD, EMERGENCY_STOP = "device/joint_trajectory", "device/hold", "device/estop"
STATUS, RESULT, JOINTS = "device/status", "device/result", "joint_states"
# No message may be lost, even if another node floods the topic.
HOLDS = Delivery(depth=100, reliable=False)
_EMERGENCY_STOPS = Delivery(depth=1000)
# Longer messages are rejected: the conversion takes up to 200 ns per byte [bytes].
_MAX_MESSAGE = 4096
# If only these fields change, the status is published at most once per period [s].
_STATUS_PERIOD = 0.5
_FREQUENT = {"insertion_m", "rotation_rad", "holds_ignored"}
_OTHERS = operator.attrgetter(*({row.name for row in dataclasses.fields(DeviceStatus)} - _FREQUENT))

Then = Callable[[ServiceResult, Moment], Actions]


@dataclasses.dataclass(frozen=True)
class _Task:
    """A procedure under way, the handler of its result, and the number of stops before it."""

    running: Running[ServiceResult]
    then: Then
    stops: int


class DeviceInterface:
    """Inputs, outputs and services that connect a motion supervisor to the graph.

    Parameters
    ----------
    supervisor : MotionSupervisor
        The motion supervisor.
    name : str
        Name of the component.
    simulated : bool or None
        Whether no real needle can move; None: not known yet.
    not_ready : callable
        Returns why services are not ready, empty if they are; stopping and disabling always are.

    Attributes
    ----------
    simulated : bool or None
        As given; the component may change it.
    """

    def __init__(
        self,
        supervisor: MotionSupervisor,
        name: str,
        *,
        simulated: bool | None,
        not_ready: Callable[[], str] = lambda: "",
    ) -> None:
        self.simulated = simulated
        self._supervisor = supervisor
        self._name = name
        self._not_ready = not_ready
        self._command_publishers = 1
        self._published: DeviceStatus | None = None
        self._published_at = 0.0
        self._notices = NoticeLimit()
        self._task: _Task | None = None
        self.inputs: Sequence[Input] = (
            Input(COMMANDS, m.Trajectory, self._on_command, max_bytes=_MAX_MESSAGE),
            Input(HOLD, m.HoldState, self._on_hold, HOLDS, _MAX_MESSAGE),
            Input(
                EMERGENCY_STOP,
                m.EmergencyStop,
                self._on_emergency_stop,
                _EMERGENCY_STOPS,
                _MAX_MESSAGE,
            ),
        )
        self.outputs: Sequence[Output] = (
            Output(JOINTS, m.JointState, JOINT_STATES),
            Output(RESULT, m.CommandResult),
            Output(STATUS, DeviceStatus, LATCHED, exclusive=True),
        )
        call = supervisor
        self.services: Sequence[Service] = (
            self._service("home", lambda _, at: call.home(at.steady)),
            self._service("retract", lambda _, at: call.retract(at.steady)),
            self._service("reset", lambda _, at: call.reset(at.steady)),
            self._service("stop", lambda _, at: call.stop()),
            self._service("enable", lambda on, at: call.enable(on, at.steady), switch=True),
            self._service(
                "confirm_needle_out", lambda on, at: call.confirm_needle_out(on), switch=True
            ),
        )

    @property
    def is_busy(self) -> bool:
        """Whether a procedure is under way."""
        return self._task is not None

    def begin(self, procedure: Procedure[ServiceResult], then: Then, at: Moment) -> Actions:
        """Begin a procedure; `then` handles its result.

        It is cancelled by a stop, an emergency stop, a fault or disabling.
        """
        self._task = _Task(Running(procedure), then, self._supervisor.stops)
        yield from self.advance(at)

    def advance(self, at: Moment) -> Actions:
        """Resume the procedure under way; call it after each event that may affect it."""
        task = self._task
        if task is None:
            return
        if self._supervisor.stops > task.stops:
            yield from self.cancel(self._supervisor.fault, at)
            return
        try:
            has_ended = task.running.advance(at.steady)
        except Exception:
            yield from self.cancel("internal error", at)
            raise
        if has_ended:
            self._task = None
            yield from self.report(at)
            yield from task.then(task.running.result[0], at)

    def cancel(self, reason: str, at: Moment) -> Actions:
        """Cancel the procedure under way; its result states the reason."""
        task, self._task = self._task, None
        if task is not None:
            task.running.cancel()
            yield from task.then(ServiceResult(False, f"cancelled: {reason}"), at)

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Check for another device, and count the publishers of commands."""
        self._command_publishers = len(peers.publishers.get(COMMANDS, ()))
        others = [name for name in peers.publishers.get(STATUS, ()) if name != self._name]
        names = ", ".join(others)
        conflict = (
            f"another device is running: {names} publishes {STATUS}; {CONFLICT_HINT}"
            if others
            else ""
        )
        self._supervisor.report_conflicting_device(conflict)
        return self.report(at)

    def report(self, at: Moment) -> Actions:
        """Publish results and a changed status, log notices; call it after each cycle."""
        for event in self._supervisor.pop_events():
            match event:
                case m.CommandResult():
                    yield Publish(RESULT, event)
                case Notice():
                    text = self._notices.admit(event, at.steady)
                    if text:
                        yield Log("error" if event.fault else "warning", text)
        status = self._supervisor.status(at.steady, self._name, simulated=self.simulated)
        if self._is_new(status, at.steady):
            self._published, self._published_at = status, at.steady
            yield Publish(STATUS, status)
            yield Diagnose("device", status.diagnostic)

    def joint_states(self, at: Moment) -> Actions:
        """Publish the measured joints, unless they are stale."""
        joints = self._supervisor.joints(at.steady)
        if joints is not None:
            axes = (joints.insertion, joints.rotation)
            message = m.JointState(
                at.stamp_ns,
                (m.INSERTION_JOINT, m.ROTATION_JOINT),
                tuple(axis.position for axis in axes),
                tuple(axis.velocity for axis in axes),
            )
            yield Publish(JOINTS, message)

    def _is_new(self, status: DeviceStatus, now: float) -> bool:
        published = self._published
        if published is None or now - self._published_at > _STATUS_PERIOD:
            return published != status
        return _OTHERS(published) != _OTHERS(status)

    def _on_command(self, message: m.Trajectory, at: Moment) -> Actions:
        self._supervisor.submit(message, at.steady, self._command_publishers)
        return self.report(at)

    def _on_hold(self, message: m.HoldState, at: Moment) -> Actions:
        self._supervisor.receive_hold(message, at.steady)
        return self.report(at)

    def _on_emergency_stop(self, message: m.EmergencyStop, at: Moment) -> Actions:
        self._supervisor.receive_estop(message.pressed)
        yield from self.advance(at)
        yield from self.report(at)

    def _service(
        self,
        name: str,
        call: Callable[[bool, Moment], ServiceResult | Procedure[ServiceResult]],
        *,
        switch: bool = False,
    ) -> Service:
        """Return a service; `switch` means that its request contains a Boolean."""

        def handle(on: bool | None, number: int, at: Moment) -> Actions:
            def reply(result: ServiceResult, _: Moment) -> Actions:
                yield Reply(number, result.success, result.message)

            not_ready = self._not_ready() or ("another command is running" if self.is_busy else "")
            # Stopping and switching off always work, and cancel a procedure.
            if name == "stop" or (switch and not on):
                yield from self.cancel("stopped on request", at)
                not_ready = ""
            result = ServiceResult(False, not_ready) if not_ready else call(bool(on), at)
            if isinstance(result, ServiceResult):
                yield from self.report(at)
                yield from reply(result, at)
            else:
                yield from self.begin(result, reply, at)

        return Service(f"device/{name}", handle, has_argument=switch)
