"""The `device/...` interface of a motion supervisor as rows of a component.

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
    Service,
)
from needle_core.component import Reply as ServiceReply
from needle_core.process.ros_domain import CONFLICT_HINT
from needle_core.status_messages import DeviceStatus
from needle_device_driver.procedure import Procedure, Running
from needle_device_driver.supervisor.command import Command, CommandPoint
from needle_device_driver.supervisor.reports import (
    Notice,
    NoticeLimit,
    Reply,
    StepResult,
)
from needle_device_driver.supervisor.supervisor import MotionSupervisor

COMMANDS, HOLD, EMERGENCY_STOP = "device/joint_trajectory", "device/hold", "device/estop"
STATUS, RESULT, JOINTS = "device/status", "device/result", "joint_states"
STOP = "device/stop"
# Every message counts, also while somebody floods the topic.
HOLDS = Delivery(depth=100, reliable=False)
_EMERGENCY_STOPS = Delivery(depth=1000)
# Turning a message into Python takes up to 200 ns a byte [bytes].
_LONGEST = 4096
# Positions, or messages that are ignored, alone change device/status so often at most [s].
_STATUS_PERIOD = 0.5
_OFTEN = {"insertion_m", "rotation_rad", "holds_ignored"}
_SELDOM = operator.attrgetter(*({row.name for row in dataclasses.fields(DeviceStatus)} - _OFTEN))


@dataclasses.dataclass(frozen=True)
class _Order:
    """An order under way, what follows it, and how many stops there were before it."""

    running: Running[Reply]
    then: Callable[[Reply, Moment], Actions]
    stops: int


class DeviceRows:
    """Rows that connect a motion supervisor to topics and services.

    Parameters
    ----------
    supervisor : MotionSupervisor
        What they speak for.
    name : str
        Name of the component.
    simulated : bool or None
        Whether no real needle can move; None until that is known.
    refuse : callable
        Returns why services are not ready yet, empty when they are; a stop and a disabling are
        never refused.

    Attributes
    ----------
    simulated : bool or None
        As given; a component may change it.
    others : str
        Who else is a device on these topics; empty: nobody.
    """

    def __init__(
        self,
        supervisor: MotionSupervisor,
        name: str,
        *,
        simulated: bool | None,
        refuse: Callable[[], str] = lambda: "",
    ) -> None:
        self.simulated = simulated
        self.others = ""
        self._supervisor = supervisor
        self._name = name
        self._refuse = refuse
        self._command_publishers = 1
        self._told: DeviceStatus | None = None
        self._told_at = 0.0
        self._notices = NoticeLimit()
        self._order: _Order | None = None
        self.inputs: Sequence[Input] = (
            Input(COMMANDS, m.Trajectory, self._on_command, max_bytes=_LONGEST),
            Input(HOLD, m.HoldState, self._on_hold, HOLDS, _LONGEST),
            Input(
                EMERGENCY_STOP,
                m.EmergencyStop,
                self._on_emergency_stop,
                _EMERGENCY_STOPS,
                _LONGEST,
            ),
        )
        self.outputs: Sequence[Output] = (
            Output(JOINTS, m.JointState, JOINT_STATES),
            Output(RESULT, m.CommandResult),
            Output(STATUS, DeviceStatus, LATCHED, exclusive=True),
        )
        call = supervisor
        self.services: Sequence[Service] = (
            self._trigger("home", lambda at: call.home(at.steady)),
            self._trigger("retract", lambda at: call.retract(at.steady)),
            self._trigger("reset", lambda at: call.reset(at.steady)),
            self._trigger("stop", lambda at: call.stop(), always=True),
            self._switch("enable", lambda on, at: call.enable(on, at.steady)),
            self._switch("confirm_needle_out", lambda on, at: call.confirm_needle_out(on)),
        )

    @property
    def is_busy(self) -> bool:
        """Tell whether an order takes its time."""
        return self._order is not None

    def begin(
        self, order: Procedure[Reply], then: Callable[[Reply, Moment], Actions], at: Moment
    ) -> Actions:
        """Begin an order that may take its time; `then` gets its reply.

        A stop, an emergency stop and a fault call it off, and so does disabling.
        """
        self._order = _Order(Running(order), then, self._supervisor.stops)
        yield from self.advance(at)

    def advance(self, at: Moment) -> Actions:
        """Go on with the order under way; call it after all that may have changed something."""
        order = self._order
        if order is None:
            return
        if self._supervisor.stops > order.stops:
            yield from self.call_off(self._supervisor.fault, at)
            return
        try:
            has_ended = order.running.advance(at.steady)
        except Exception:
            yield from self.call_off("internal error", at)
            raise
        if has_ended:
            self._order = None
            yield from self.report(at)
            yield from order.then(order.running.result[0], at)

    def call_off(self, why: str, at: Moment) -> Actions:
        """End the order under way where it is; its reply says why."""
        order, self._order = self._order, None
        if order is not None:
            order.running.cancel()
            yield from order.then(Reply(False, f"called off: {why}"), at)

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Note who else is a device on these topics, and how many send commands."""
        self._command_publishers = len(peers.publishers.get(COMMANDS, ()))
        others = [name for name in peers.publishers.get(STATUS, ()) if name != self._name]
        names = ", ".join(others)
        self.others = (
            f"another device is there: {names} publishes {STATUS}; {CONFLICT_HINT}"
            if others
            else ""
        )
        self._supervisor.see_others(self.others)
        return self.report(at)

    def report(self, at: Moment) -> Actions:
        """Return results, notices and a changed status; call it after each cycle."""
        for event in self._supervisor.take_events():
            match event:
                case StepResult(stamp_ns, outcome):
                    yield Publish(RESULT, m.CommandResult(stamp_ns, outcome))
                case Notice():
                    text = self._notices.admit(event, at.steady)
                    if text:
                        yield Log("error" if event.fault else "warning", text)
        status = self._supervisor.status(at.steady, self._name, simulated=self.simulated)
        if self._is_news(status, at.steady):
            self._told, self._told_at = status, at.steady
            yield Publish(STATUS, status)
            yield Diagnose("device", status.diagnostic)

    def joint_states(self, at: Moment) -> Actions:
        """Return the measured joints, unless they are stale."""
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

    def _is_news(self, status: DeviceStatus, now: float) -> bool:
        told = self._told
        if told is None or now - self._told_at > _STATUS_PERIOD:
            return told != status
        return _SELDOM(told) != _SELDOM(status)

    def _on_command(self, message: m.Trajectory, at: Moment) -> Actions:
        points = tuple(
            CommandPoint(point.positions, point.others, point.time_from_start)
            for point in message.points
        )
        command = Command(message.stamp_ns, message.joint_names, points)
        self._supervisor.submit(command, at.steady, self._command_publishers)
        return self.report(at)

    def _on_hold(self, message: m.HoldState, at: Moment) -> Actions:
        self._supervisor.receive_hold(message, at.steady)
        return self.report(at)

    def _on_emergency_stop(self, message: m.EmergencyStop, at: Moment) -> Actions:
        self._supervisor.receive_estop(message.pressed)
        yield from self.advance(at)
        yield from self.report(at)

    def _trigger(
        self,
        name: str,
        call: Callable[[Moment], Reply | Procedure[Reply]],
        *,
        always: bool = False,
    ) -> Service:
        def answer(_: bool | None, number: int, at: Moment) -> Actions:
            return self._answer(number, at, lambda: call(at), always=always)

        return Service(f"device/{name}", answer)

    def _switch(self, name: str, call: Callable[[bool, Moment], Reply]) -> Service:
        def answer(on: bool | None, number: int, at: Moment) -> Actions:
            return self._answer(number, at, lambda: call(bool(on), at), always=not on)

        return Service(f"device/{name}", answer, has_argument=True)

    def _answer(
        self,
        number: int,
        at: Moment,
        call: Callable[[], Reply | Procedure[Reply]],
        *,
        always: bool,
    ) -> Actions:
        def answer(reply: Reply, _: Moment) -> Actions:
            yield ServiceReply(number, reply.success, reply.message)

        if always:
            yield from self.call_off("stopped on request", at)
        why_not = "" if always else self._refuse() or self._under_way
        outcome = Reply(False, why_not) if why_not else call()
        if isinstance(outcome, Reply):
            yield from self.report(at)
            yield from answer(outcome, at)
        else:
            yield from self.begin(outcome, answer, at)

    @property
    def _under_way(self) -> str:
        return "another order is under way" if self.is_busy else ""
