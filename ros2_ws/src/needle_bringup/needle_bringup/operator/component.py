"""operator as a component: publishes the hold-to-run of a pedal, key or joystick."""

from __future__ import annotations

from collections.abc import Sequence

from needle_bringup.operator.hold_debouncer import (
    HoldDebouncer,
    HoldDecision,
    HoldKind,
    InputReading,
)
from needle_bringup.operator.joy_source import JoySource
from needle_bringup.operator.parameters import JOY, PERIOD, OperatorParameters
from needle_core import messages as m
from needle_core.commands.cli import EXIT_DONE
from needle_core.component import (
    BEST_EFFORT,
    LATCHED,
    Actions,
    Answer,
    Call,
    Component,
    Diagnose,
    Exit,
    Input,
    Log,
    Moment,
    Output,
    Peers,
    Port,
    Publish,
    Send,
    Timer,
)
from needle_core.diagnostics import Diagnostic, Level
from needle_core.messages import HoldSession
from needle_core.retraction import RETRACT, STOP_STEERING, Retraction
from needle_core.status_messages import ControllerStatus, DeviceStatus

HOLD, INPUT_DEVICE = "device/hold", "input device"
CONTROLLER_STATUS = "needle/controller_status"
DEVICE_STOP = "device/stop"
RELEASES = 3
"""Number of final release messages, as delivery of the hold is best effort."""


class Operator(Component):
    """Turns the controls of an input device or a joystick's topic into device/hold.

    The port reads the input device every `PERIOD`; the last message of a joystick is evaluated at
    the same rate.

    Parameters
    ----------
    settings : OperatorParameters
        The node's parameters.
    name : str
        Name of the node, which identifies the owner of the hold.
    joy : str
        Topic of the joystick.
    """

    def __init__(
        self, settings: OperatorParameters, name: str = "operator", joy: str = "joy"
    ) -> None:
        self.name = name
        self.settings = settings
        self._peers = Peers()
        self._joy, self._joy_topic = JoySource(settings), joy
        self._debouncer = HoldDebouncer()
        self._retraction = Retraction()
        self._device, self._controller = DeviceStatus(), ControllerStatus()
        self._decision = HoldDecision()
        # Reason why a call of the current retraction failed.
        self._refusal = ""
        self._last_text = ""
        self._session = HoldSession(name)
        self.inputs = (
            Input("device/status", DeviceStatus, self._on_device, LATCHED),
            Input(CONTROLLER_STATUS, ControllerStatus, self._on_controller, LATCHED),
        )
        self.outputs = (Output(HOLD, m.HoldState, BEST_EFFORT),)
        if settings.source == JOY:
            # Queue depth 1: messages queued during a stall are outdated.
            self.inputs += (Input(joy, m.Joystick, self._on_joy, BEST_EFFORT),)
            self.timers = (Timer(PERIOD, self._on_timer),)
        else:
            self.ports = (Port(INPUT_DEVICE, self._on_readings),)

    def on_settings(self, settings: OperatorParameters, at: Moment) -> Actions:
        """Apply a changed speed."""
        self.settings = settings
        if self.ports:
            yield Send(INPUT_DEVICE, (settings.speed_scale,))

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Store the joystick's publishers, and forget a controller that has ended."""
        self._peers = peers
        if CONTROLLER_STATUS not in peers.publishers:
            self._controller = ControllerStatus()
        return ()

    def on_answer(self, answer: Answer, at: Moment) -> Actions:
        """Store the reason why a retraction fails."""
        if answer.service in {STOP_STEERING, RETRACT} and not answer.success:
            self._refusal = f"{answer.service}: {answer.text}"
        return ()

    def on_stop(self, at: Moment) -> Actions:
        """Release the hold, and exit."""
        for _ in range(RELEASES):
            yield self._hold(at, pressed=False)
        yield Exit(EXIT_DONE)

    def _hold(self, at: Moment, *, pressed: bool, speed: float = 0.0) -> Publish:
        return Publish(HOLD, self._session.next_message(at.stamp_ns, pressed=pressed, speed=speed))

    def _on_joy(self, message: m.Joystick, at: Moment) -> Actions:
        stamp = message.stamp_ns / 1e9
        self._joy.receive(message.axes, message.buttons, at.steady, stamp=stamp)
        return ()

    def _on_timer(self, at: Moment) -> Actions:
        publishers = len(self._peers.publishers.get(self._joy_topic, ()))
        return self._update(self._joy.read(at.steady, self.settings.speed_scale, publishers), at)

    def _on_readings(self, readings: Sequence[InputReading], at: Moment) -> Actions:
        return self._update(readings[-1], at)

    def _update(self, reading: InputReading, at: Moment) -> Actions:
        decision = self._decision = self._debouncer.update(reading, at.steady)
        retracts = decision.kind is HoldKind.RETRACT
        order = self._retraction.update(
            retracts,
            at.steady,
            steering=self._controller.is_steering,
            hold_counts=self._device.is_idle_for(self.name),
        )
        if not retracts:
            self._refusal = ""
        pressed = decision.kind is HoldKind.INSERT or order.press
        yield self._hold(at, pressed=pressed, speed=decision.speed)
        if decision.stop:
            yield Call(DEVICE_STOP)
        yield from map(Call, order.calls)
        yield from self._report()

    def _on_device(self, message: DeviceStatus, at: Moment) -> Actions:
        self._device = message
        return ()

    def _on_controller(self, message: ControllerStatus, at: Moment) -> Actions:
        self._controller = message
        return ()

    def _report(self) -> Actions:
        level, text = self._health()
        yield Diagnose("hold", Diagnostic(level, text))
        if text != self._last_text:
            self._last_text = text
            yield Log("info" if level is Level.OK else "warning", text)

    def _health(self) -> tuple[Level, str]:
        decision = self._decision
        if decision.problem:
            return Level.WARN, f"nothing is held: {decision.problem}"
        if self._refusal:
            return Level.WARN, f"not withdrawn: {self._refusal}"
        if decision.ignored_press:
            return Level.WARN, "the press is ignored: release all buttons, then press again"
        if self._device.press_again == self.name and decision.kind is not HoldKind.NOTHING:
            return Level.WARN, "the device ignores this press: release, then press again"
        return Level.OK, {
            HoldKind.NOTHING: "nothing is held",
            HoldKind.INSERT: "held to insert",
            HoldKind.RETRACT: "held to withdraw the needle",
        }[decision.kind]
