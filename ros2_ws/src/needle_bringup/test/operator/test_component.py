"""The operator as a component: a hand at its port, or on a joystick's topic."""

from __future__ import annotations

from needle_bringup.operator.component import INPUT_DEVICE, Operator
from needle_bringup.operator.hand import Hand, Lost, Reading
from needle_bringup.operator.parameters import OperatorParameters
from needle_core import messages as m
from needle_core.component import (
    BEST_EFFORT,
    Actions,
    Component,
    Moment,
    Output,
    Port,
    Publish,
    Reply,
    Send,
    Service,
    Timer,
)
from needle_core.runners.virtual import VirtualRunner

PEDAL = OperatorParameters(device="/dev/input/pedal", key=48, retract_key=49)
JOYSTICK = OperatorParameters(source="joy", key=0, retract_key=1, speed_axis=0)
NEUTRAL = Hand()


class Held(Component):
    """A pedal at the port, and a joystick; answers what is called."""

    name = "held"

    def __init__(self) -> None:
        self.reading: Reading = Hand()
        self.joystick = m.Joystick(0, (0.6,), (0, 0))
        self.called: list[str] = []
        self.outputs = (Output("joy", m.Joystick, BEST_EFFORT),)
        self.ports = (Port(INPUT_DEVICE, lambda *_: ()),)
        self.services = (Service("plane_controller/stop", self._answer),)
        self.timers = (Timer(0.02, self._tell),)

    def _tell(self, at: Moment) -> Actions:
        yield Send(INPUT_DEVICE, (Lost("an older reading"), self.reading))
        yield Publish("joy", self.joystick)

    def _answer(self, _: bool | None, number: int, at: Moment) -> Actions:
        self.called.append("plane_controller/stop")
        yield Reply(number, True)


class Scene:
    """An operator before a hand, and the holds that it publishes."""

    def __init__(self, settings: OperatorParameters) -> None:
        self.holds: list[m.HoldState] = []
        self.held = Held()
        self.runner = VirtualRunner([Operator(settings), self.held], 1, taps=(self._note,))
        self.runner.run(0.5)

    def _note(self, stamp_ns: int, sender: str, message: object, output: Output) -> None:
        if isinstance(message, m.HoldState):
            self.holds.append(message)

    def then(self, reading: Reading = NEUTRAL, buttons: tuple[int, ...] = (0, 0)) -> m.HoldState:
        self.held.reading = reading
        self.held.joystick = m.Joystick(0, (0.6,), buttons)
        self.runner.run(0.1)
        return self.holds[-1]


def test_a_pedal_at_the_port_is_held_until_it_is_lost() -> None:
    scene = Scene(PEDAL)
    assert not scene.then().pressed
    held = scene.then(Hand(insert=True, speed=0.5))
    assert (held.source, held.pressed, held.speed_scale) == ("operator", True, 0.5)
    assert held.lifetime == m.HOLD_LIFETIME
    assert not scene.then(Lost("unplugged")).pressed
    assert not scene.then(Hand(insert=True)).pressed
    assert [hold.count for hold in scene.holds] == list(range(1, len(scene.holds) + 1))
    assert len({hold.session for hold in scene.holds}) == 1


def test_a_joystick_holds_at_its_axis_speed() -> None:
    scene = Scene(JOYSTICK)
    assert not scene.then().pressed
    held = scene.then(buttons=(1, 0))
    assert held.pressed
    assert round(held.speed_scale, 6) == 0.8


def test_the_controller_is_stopped_before_the_needle_is_drawn_out() -> None:
    scene = Scene(PEDAL)
    scene.then()
    scene.then(Hand(retract=True))
    assert scene.held.called == ["plane_controller/stop"]
    assert scene.holds[-1].pressed


def test_whoever_ends_releases() -> None:
    scene = Scene(PEDAL)
    scene.then()
    assert scene.then(Hand(insert=True)).pressed
    scene.runner.stop("operator")
    assert scene.runner.run(1.0)
    assert scene.runner.exits["operator"].code == 0
    assert [hold.pressed for hold in scene.holds[-3:]] == [False] * 3
