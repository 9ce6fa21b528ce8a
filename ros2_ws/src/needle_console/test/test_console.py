"""The console as a component, on the virtual runner: what a page does, and what the rig is told."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from needle_console.console import PAGE, Console, Hand, Lag, PageEvent, View
from needle_console.console_parameters import ConsoleParameters
from needle_console.hold.hold_state import RELEASED, HoldState, Mode
from needle_console.page.desk import Desk
from needle_console.view.advice import Button
from needle_console.view.snapshot import Snapshot
from needle_console.view.targets import plane_pose, target_point
from needle_core import messages as m
from needle_core.component import (
    LATCHED,
    Actions,
    Component,
    Exit,
    Input,
    Listen,
    Moment,
    Output,
    Port,
    Publish,
    Reply,
    Send,
    Service,
    Timer,
)
from needle_core.diagnostics import Level
from needle_core.runners.virtual import VirtualRunner
from needle_core.status_messages import ControllerStatus, DeviceStatus

INSERT = HoldState(True, 0.5, Mode.INSERT)
RETRACT = HoldState(True, 0.5, Mode.RETRACT)
PERIOD = 0.02


class Page(Component):
    """Pages and the hold's server in one: tells its hand as often as the server does."""

    name = "page"

    def __init__(self) -> None:
        self.hand = RELEASED
        self.refused: dict[str, int] = {}
        self.wishes: list[PageEvent] = []
        self.shown: list[Any] = []
        self.is_served = True
        self.ports = (Port(PAGE, self._see),)
        self.timers = (Timer(PERIOD, self._tell),)

    @property
    def snapshot(self) -> Snapshot:
        return [shown for shown in self.shown if isinstance(shown, Snapshot)][-1]

    def _see(self, batch: Sequence[Any], at: Moment) -> Actions:
        self.shown += batch
        return ()

    def _tell(self, at: Moment) -> Actions:
        events, self.wishes = tuple(self.wishes), []
        hands = (Hand(self.hand, self.refused),) if self.is_served else ()
        yield Send(PAGE, (*events, *hands))


class Rig(Component):
    """Device and controller: says what it is told to, and notes what it hears."""

    name = "rig"

    def __init__(self) -> None:
        self.holds: list[m.HoldState] = []
        self.targets: list[Any] = []
        self.calls: list[tuple[str, bool | None]] = []
        self.health: list[m.Status] = []
        self.device = {"state": "HOLDING", "activity": "none", "hold_owner": ""}
        self.controller = {"state": "IDLE"}
        self.takes = True
        self.inputs = (
            Input("device/hold", m.HoldState, self._on_hold),
            Input("target_plane", m.Pose, self._on_target, LATCHED),
            Input("target_point", m.Point, self._on_target, LATCHED),
            Input("/diagnostics", m.Diagnostics, self._on_health),
        )
        self.outputs = (
            Output("device/status", DeviceStatus, LATCHED),
            Output("needle/controller_status", ControllerStatus, LATCHED),
            Output("stereo/left/image_raw", m.Image),
        )
        self.services = tuple(
            Service(name, self._serve(name), has_argument="enable" in name or "confirm" in name)
            for name in (
                "device/confirm_needle_out",
                "device/enable",
                "device/stop",
                "device/retract",
                "plane_controller/start",
                "plane_controller/stop",
            )
        )
        self.timers = (Timer(PERIOD, self._report),)

    def level(self) -> Level:
        return self.health[-1].level

    def _serve(self, name: str) -> Any:
        def serve(argument: bool | None, number: int, at: Moment) -> Actions:
            self.calls.append((name, argument))
            yield Reply(number, self.takes, "as asked" if self.takes else "not now")

        return serve

    def _on_hold(self, message: m.HoldState, at: Moment) -> Actions:
        self.holds.append(message)
        return ()

    def _on_target(self, message: Any, at: Moment) -> Actions:
        self.targets.append(message)
        return ()

    def _on_health(self, message: m.Diagnostics, at: Moment) -> Actions:
        self.health += message.statuses
        return ()

    def _report(self, at: Moment) -> Actions:
        yield Publish("device/status", DeviceStatus.parse(self.device))
        yield Publish("needle/controller_status", ControllerStatus.parse(self.controller))
        image = m.Image(at.stamp_ns, "left", 2, 3, "mono8", 4, bytes(range(8)))
        yield Publish("stereo/left/image_raw", image)


class Taken:
    """A desk, its clock, and what it hands over."""

    def __init__(self) -> None:
        self.now = 10.0
        self.batches: list[Any] = []
        self.desk = Desk(ConsoleParameters(), lambda: self.now)
        self.desk.open(self.batches.append)

    def events(self) -> list[PageEvent]:
        """Return what is handed over now."""
        batches = [batch() for batch in self.batches]
        self.batches.clear()
        return [event for batch in batches for event in batch]

    def hands(self) -> list[HoldState]:
        return [event.state for event in self.events() if isinstance(event, Hand)]


class Scene:
    """A console between a page and a rig."""

    def __init__(self) -> None:
        self.page, self.rig = Page(), Rig()
        console = Console(ConsoleParameters())
        self.runner = VirtualRunner([console, self.page, self.rig])
        self.forward(1.0)

    def forward(self, seconds: float) -> None:
        self.runner.run(seconds)

    def holds(self, seconds: float) -> list[m.HoldState]:
        """Return what is heard of the hold meanwhile."""
        begin = len(self.rig.holds)
        self.forward(seconds)
        return self.rig.holds[begin:]


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_a_hold_is_told_as_it_comes_and_ends_with_its_lifetime(scene: Scene) -> None:
    scene.page.hand = INSERT
    holds = scene.holds(1.0)
    assert len(holds) == pytest.approx(1.0 / PERIOD, abs=2)
    last = holds[-1]
    assert (last.source, last.pressed, last.speed_scale) == ("console", True, 0.5)
    assert last.lifetime == m.HOLD_LIFETIME
    # The component repeats nothing by itself: a page's server that is gone holds no longer.
    scene.page.is_served = False
    scene.forward(PERIOD)
    assert scene.holds(1.0) == []


def test_a_release_is_told_at_once_and_counts_increase(scene: Scene) -> None:
    scene.page.hand = INSERT
    scene.forward(0.5)
    scene.page.hand = RELEASED
    holds = scene.holds(2.0 * PERIOD)
    assert not holds[-1].pressed
    assert holds[-1].speed_scale == 0.0
    scene.page.wishes = [Hand(INSERT), Hand(RELEASED), Hand(INSERT)]
    scene.forward(0.5)
    counts = [hold.count for hold in scene.rig.holds]
    assert counts == sorted(set(counts))


def test_a_retraction_waits_for_the_end_of_steering_and_is_called_once(scene: Scene) -> None:
    scene.rig.controller["state"] = "STEERING"
    scene.forward(0.1)
    scene.page.hand = RETRACT
    assert not any(hold.pressed or hold.speed_scale for hold in scene.holds(0.5))
    assert scene.rig.calls == [("plane_controller/stop", None)]
    scene.rig.controller["state"] = "IDLE"
    scene.rig.device["hold_owner"] = "console"
    assert scene.holds(0.5)[-1].pressed
    assert scene.rig.calls[1:] == [("device/retract", None)]


def test_a_controller_that_is_gone_keeps_no_needle_in() -> None:
    console, page = Console(ConsoleParameters()), Page()
    runner = VirtualRunner([console, page])
    steering = ControllerStatus(state="STEERING")
    at = Moment(0.0, 1)
    row = next(row for row in console.inputs if row.topic == "needle/controller_status")
    assert list(row.handler(steering, at)) == []
    runner.run(0.5)
    assert page.snapshot.controller is None


def test_buttons_call_their_services_and_answers_are_shown(scene: Scene) -> None:
    scene.page.wishes = [Button.CONFIRM, Button.SWITCH_OFF, Button.STOP]
    scene.forward(0.2)
    assert set(scene.rig.calls) == {
        ("device/confirm_needle_out", True),
        ("device/enable", False),
        ("device/stop", None),
    }
    assert scene.page.snapshot.answer.endswith(": as asked")
    scene.rig.takes = False
    scene.page.wishes = [Button.START]
    scene.forward(0.3)
    assert scene.page.snapshot.answer == "plane_controller/start: refused: not now"
    scene.page.wishes = [Button.HOME]
    scene.forward(0.3)
    assert scene.page.snapshot.answer == "device/home: no server"


def test_the_hands_server_that_falls_silent_is_named(scene: Scene) -> None:
    scene.page.refused = {"foreign Host": 3}
    scene.forward(1.5)
    assert scene.rig.health[-1].values == {"refused foreign Host": "3"}
    assert scene.rig.level() == Level.OK
    scene.page.is_served = False
    scene.forward(3.0)
    assert scene.rig.level() == Level.ERROR
    scene.page.is_served = True
    scene.forward(0.2)
    assert scene.rig.level() == Level.OK


def test_targets_and_images_go_through(scene: Scene) -> None:
    taken = Taken()
    taken.desk.send_plane(plane_pose(4.0, 30.0))
    taken.desk.send_point(target_point(10.0, -5.0, 100.0))
    scene.page.wishes = taken.events()
    scene.forward(0.3)
    plane, point = scene.rig.targets
    assert plane.orientation == pytest.approx((0.0, np.sin(np.pi / 12), 0.0, np.cos(np.pi / 12)))
    assert point == m.Point(0, "rig", (0.01, -0.005, 0.1))
    views = [shown for shown in scene.page.shown if isinstance(shown, View)]
    assert views[-1].side == "left"
    # What pads a row is left out.
    assert views[-1].image.tolist() == [[0, 1, 2], [4, 5, 6]]


def test_a_simulation_that_lags_is_named_while_it_does(scene: Scene) -> None:
    for seconds in (0.0, 0.01, 1.0):
        assert scene.page.snapshot.troubles == ()
        scene.page.wishes = [Lag(seconds)]
        scene.forward(0.3)
    (text,) = scene.page.snapshot.troubles
    assert "1.0 s behind the clock" in text
    # It lags no more than it did.
    scene.forward(2.0)
    scene.page.wishes = [Lag(1.0)]
    scene.forward(2.0)
    assert scene.page.snapshot.troubles == ()


# ---- the desk, with its own clock ---------------------------------------------------------------


def test_of_holds_that_wait_the_newest_counts_unless_one_was_a_release() -> None:
    taken = Taken()
    for state in (RETRACT, INSERT):
        taken.desk.hold(state)
    assert taken.hands() == [INSERT]
    assert taken.hands() == []
    for state in (INSERT, RELEASED, INSERT):
        taken.desk.hold(state)
    assert taken.hands() == [RELEASED]
    taken.desk.hold(INSERT)
    assert taken.hands() == [INSERT]


def test_a_hold_that_has_waited_for_longer_than_it_counts_is_a_release() -> None:
    taken = Taken()
    taken.desk.hold(INSERT)
    taken.now += m.HOLD_LIFETIME
    assert taken.hands() == [INSERT]
    taken.desk.hold(INSERT)
    taken.now += 1.01 * m.HOLD_LIFETIME
    assert taken.hands() == [RELEASED]


def test_wishes_of_pages_that_nobody_takes_are_not_piled_up() -> None:
    taken = Taken()
    for _ in range(1000):
        taken.desk.press(Button.HOME)
    assert 0 < len(taken.events()) < 100
    assert taken.events() == []


def test_images_are_wanted_while_a_page_asks_for_views() -> None:
    console = Console(ConsoleParameters())
    (port,) = console.ports
    taken = Taken()

    def listens(actions: Actions) -> dict[str, bool]:
        return {act.topic: act.on for act in actions if isinstance(act, Listen)}

    both = ("stereo/left/image_raw", "stereo/right/image_raw")
    taken.desk.picture("left")
    assert listens(port.handler(taken.events(), Moment(5.0, 1))) == dict.fromkeys(both, True)
    check = console.timers[1].handler
    assert listens(check(Moment(6.9, 1))) == {}
    assert listens(check(Moment(7.1, 1))) == dict.fromkeys(both, False)


def test_its_end_releases_the_hold() -> None:
    release, end = Console(ConsoleParameters()).on_stop(Moment(5.0, 1))
    assert isinstance(release, Publish)
    assert not release.message.pressed
    assert end == Exit(0)
