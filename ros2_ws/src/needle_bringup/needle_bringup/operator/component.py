"""operator as a component: what a person holds becomes the hold to run."""

from __future__ import annotations

from collections.abc import Sequence

from needle_bringup.operator.hand import Reading
from needle_bringup.operator.hold_gate import Grip, Held, HoldGate
from needle_bringup.operator.joy_source import JoySource
from needle_bringup.operator.parameters import JOY, OperatorParameters
from needle_bringup.operator.retraction import STOP_STEERING, RetractionSequence
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
from needle_core.status_messages import DeviceStatus

HOLD, INPUT_DEVICE = "device/hold", "input device"
PERIOD = 0.02
"""Between two looks at the hand [s]."""
DEVICE_STOP = "device/stop"
RELEASES = 3
"""The hold is best effort: a release worth sending is worth sending again."""


class Operator(Component):
    """Turns readings of a hand, from a port or a joystick's topic, into the hold.

    Whoever is at the port reads the input device every `PERIOD`; a joystick's topic is looked at as
    often.

    Parameters
    ----------
    settings : OperatorParameters
        The node's parameters.
    name : str
        Name of the node, by which the device knows whose hold it is.
    joy : str
        The joystick's topic.
    """

    def __init__(
        self, settings: OperatorParameters, name: str = "operator", joy: str = "joy"
    ) -> None:
        self.name = name
        self.settings = settings
        self._peers = Peers()
        self._joy = JoySource(
            settings.controls,
            lambda: self.settings.speed_scale,
            lambda: len(self._peers.publishers.get(joy, ())),
        )
        self._gate = HoldGate()
        self._retraction = RetractionSequence(name)
        self._grip = Grip()
        self._press_again = False
        self._told = ""
        self._session = HoldSession(name)
        self.inputs = (Input("device/status", DeviceStatus, self._on_device, LATCHED),)
        self.outputs = (Output(HOLD, m.HoldState, BEST_EFFORT),)
        if settings.source == JOY:
            # The newest alone: what waited behind a stall is no hand of now.
            self.inputs += (Input(joy, m.Joystick, self._on_joy, BEST_EFFORT),)
            self.timers = (Timer(PERIOD, lambda at: self._look(self._joy.read(at.steady), at)),)
        else:
            self.ports = (Port(INPUT_DEVICE, self._on_readings),)

    @property
    def trouble(self) -> str:
        """Trouble with the hand to follow; empty: there is none."""
        return self._grip.trouble

    def on_settings(self, settings: OperatorParameters, at: Moment) -> Actions:
        """Take another speed."""
        self.settings = settings
        if self.ports:
            yield Send(INPUT_DEVICE, (settings.speed_scale,))

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Note whether there is a controller, and how many joysticks."""
        self._peers = peers
        return ()

    def on_answer(self, answer: Answer, at: Moment) -> Actions:
        """Take the answer to a call."""
        if answer.answered:
            self._retraction.take_answer(answer.service, answer.success, answer.text, at.steady)
        return ()

    def on_stop(self, at: Moment) -> Actions:
        """Release what is held, and exit."""
        for _ in range(RELEASES):
            yield self._hold(at, pressed=False)
        yield Exit(EXIT_DONE)

    def _hold(self, at: Moment, *, pressed: bool, speed: float = 0.0) -> Publish:
        return Publish(HOLD, self._session.next_message(at.stamp_ns, pressed=pressed, speed=speed))

    def _on_joy(self, message: m.Joystick, at: Moment) -> Actions:
        stamp = message.stamp_ns / 1e9
        self._joy.take(message.axes, message.buttons, at.steady, stamp=stamp)
        return ()

    def _on_readings(self, readings: Sequence[Reading], at: Moment) -> Actions:
        return self._look(readings[-1], at)

    def _look(self, reading: Reading, at: Moment) -> Actions:
        grip = self._grip = self._gate.take(reading, at.steady)
        controller = STOP_STEERING in self._peers.services
        call = self._retraction.look(grip.held is Held.RETRACT, at.steady, controller=controller)
        pressed = grip.held is Held.INSERT or self._retraction.holds
        yield self._hold(at, pressed=pressed, speed=grip.speed)
        if grip.stop:
            yield Call(DEVICE_STOP)
        if call is not None:
            yield Call(call)
        yield from self._report()

    def _on_device(self, message: DeviceStatus, at: Moment) -> Actions:
        self._press_again = message.press_again == self.name
        self._retraction.see_device(message.hold_owner, message.activity, at.steady)
        return ()

    def _report(self) -> Actions:
        level, text = self._health()
        yield Diagnose("hold", Diagnostic(level, text))
        if text != self._told:
            self._told = text
            yield Log("info" if level is Level.OK else "warning", text)

    def _health(self) -> tuple[Level, str]:
        grip = self._grip
        if grip.trouble:
            return Level.WARN, f"nothing is held: {grip.trouble}"
        if self._retraction.trouble:
            return Level.WARN, f"not drawn out: {self._retraction.trouble}"
        if grip.unheeded:
            return Level.WARN, "what is held does not count: let go of all, then press again"
        if self._press_again and grip.held is not Held.NOTHING:
            return Level.WARN, "the device does not take this press: let go, then press again"
        return Level.OK, {
            Held.NOTHING: "nothing is held",
            Held.INSERT: "held to insert",
            Held.RETRACT: "held to draw the needle out",
        }[grip.held]
