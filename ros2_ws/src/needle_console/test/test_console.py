"""The console as a component, on the virtual runner: what a page does, and what the rig is told."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from needle_console.console import PAGE, Console, Hand, Lag, PageEvent
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
    Log,
    Moment,
    Output,
    Peers,
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
TURN = (0.0, float(np.sin(np.pi / 12)), 0.0, float(np.cos(np.pi / 12)))
"""By 30 degrees, as a plane's that rises inwards."""
PERIOD = 0.02


class Page(Component):
    """Pages and the hold's server in one: tells its hand as often as the server does."""

    name = "page"

    def __init__(self) -> None:
        self.hand = RELEASED
        self.refused: dict[str, int] = {}
        self.wishes: list[PageEvent] = []
        self.snapshot = Snapshot()
        self.is_served = True
        self.ports = (Port(PAGE, self._see),)
        self.timers = (Timer(PERIOD, self._tell),)

    def _see(self, batch: Sequence[Any], at: Moment) -> Actions:
        (self.snapshot,) = batch
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
        self.calls: list[tuple[str, bool | None]] = []
        self.health: list[m.Status] = []
        self.device = {"state": "HOLDING", "activity": "none", "hold_owner": ""}
        self.controller = {"state": "IDLE"}
        self.takes = True
        self.inputs = (
            Input("device/hold", m.HoldState, self._on_hold),
            Input("/diagnostics", m.Diagnostics, self._on_health),
        )
        self.outputs = (
            Output("device/status", DeviceStatus, LATCHED),
            Output("needle/controller_status", ControllerStatus, LATCHED),
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

    def _serve(self, name: str) -> Any:
        def serve(argument: bool | None, number: int, at: Moment) -> Actions:
            self.calls.append((name, argument))
            yield Reply(number, self.takes, "as asked" if self.takes else "not now")

        return serve

    def _on_hold(self, message: m.HoldState, at: Moment) -> Actions:
        self.holds.append(message)
        return ()

    def _on_health(self, message: m.Diagnostics, at: Moment) -> Actions:
        self.health += message.statuses
        return ()

    def _report(self, at: Moment) -> Actions:
        yield Publish("device/status", DeviceStatus.parse(self.device))
        yield Publish("needle/controller_status", ControllerStatus.parse(self.controller))


class Scene:
    """A console between a page and a rig."""

    def __init__(self) -> None:
        self.page, self.rig = Page(), Rig()
        self.runner = VirtualRunner([Console(ConsoleParameters()), self.page, self.rig])
        self.runner.run(1.0)

    def holds(self, seconds: float) -> list[m.HoldState]:
        """Return what is heard of the hold meanwhile."""
        begin = len(self.rig.holds)
        self.runner.run(seconds)
        return self.rig.holds[begin:]

    def wish(self, *events: PageEvent) -> None:
        self.page.wishes = list(events)
        self.runner.run(0.3)


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_a_hold_is_told_as_it_comes_and_ends_with_its_lifetime(scene: Scene) -> None:
    scene.page.hand = INSERT
    holds = scene.holds(1.0)
    assert len(holds) == pytest.approx(1.0 / PERIOD, abs=2)
    last = holds[-1]
    assert (last.source, last.pressed, last.speed_scale) == ("console", True, 0.5)
    # The promise of docs/safety.md.
    assert last.lifetime == m.HOLD_LIFETIME == 0.1
    # The component repeats nothing by itself: a page's server that is gone holds no longer.
    scene.page.is_served = False
    scene.runner.run(PERIOD)
    assert scene.holds(1.0) == []


def test_a_release_is_told_at_once_and_no_press_that_had_to_wait(scene: Scene) -> None:
    scene.page.hand = INSERT
    scene.runner.run(0.5)
    scene.page.hand = RELEASED
    last = scene.holds(2.0 * PERIOD)[-1]
    assert (last.pressed, last.speed_scale) == (False, 0.0)
    begin = len(scene.rig.holds)
    scene.wish(Hand(INSERT), Hand(RELEASED), Hand(INSERT))
    assert not any(hold.pressed for hold in scene.rig.holds[begin:])
    counts = [hold.count for hold in scene.rig.holds]
    assert counts == sorted(set(counts))


def test_a_retraction_waits_for_the_end_of_steering_and_is_called_once(scene: Scene) -> None:
    scene.rig.controller["state"] = "STEERING"
    scene.runner.run(0.1)
    scene.page.hand = RETRACT
    assert not any(hold.pressed or hold.speed_scale for hold in scene.holds(0.5))
    assert scene.rig.calls == [("plane_controller/stop", None)]
    scene.rig.controller["state"] = "IDLE"
    scene.rig.device["hold_owner"] = "console"
    assert scene.holds(0.5)[-1].pressed
    assert scene.rig.calls[1:] == [("device/retract", None)]


def test_buttons_call_their_services_and_answers_are_shown(scene: Scene) -> None:
    scene.wish(Button.CONFIRM, Button.SWITCH_OFF, Button.STOP)
    assert set(scene.rig.calls) == {
        ("device/confirm_needle_out", True),
        ("device/enable", False),
        ("device/stop", None),
    }
    assert scene.page.snapshot.answer.endswith(": as asked")
    scene.rig.takes = False
    for button, answer in (
        (Button.START, "plane_controller/start: refused: not now"),
        (Button.HOME, "device/home: no server"),
    ):
        scene.wish(button)
        assert scene.page.snapshot.answer == answer


def test_the_hands_server_that_falls_silent_is_named(scene: Scene) -> None:
    scene.page.refused = {"foreign Host": 3}
    for served, seconds, level in ((True, 1.5, Level.OK), (False, 3.0, Level.ERROR)):
        scene.page.is_served = served
        scene.runner.run(seconds)
        last = scene.rig.health[-1]
        assert (last.level, last.values) == (level, {"refused foreign Host": "3"})
    scene.page.is_served = True
    scene.runner.run(0.2)
    assert scene.rig.health[-1].level == Level.OK


def test_a_simulation_that_lags_is_named_while_it_does(scene: Scene) -> None:
    for seconds in (0.0, 0.01, 1.0):
        assert scene.page.snapshot.troubles == ()
        scene.wish(Lag(seconds))
    (text,) = scene.page.snapshot.troubles
    assert "1.0 s behind the clock" in text
    # It lags no more than it did.
    scene.runner.run(2.0)
    scene.wish(Lag(1.0))
    scene.runner.run(2.0)
    assert scene.page.snapshot.troubles == ()


# ---- the component, called directly --------------------------------------------------------------


class Bench:
    """A console, and the desk of its page with a clock of its own."""

    def __init__(self) -> None:
        self.now = 10.0
        self.console = Console(ConsoleParameters())
        self.desk = Desk(ConsoleParameters(), lambda: self.now)
        self._batches: list[Any] = []
        self.desk.open(self._batches.append)

    def hear(self, topic: str, message: Any) -> list[Any]:
        (row,) = (row for row in self.console.inputs if row.topic == topic)
        return list(row.handler(message, self.at))

    def events(self) -> list[PageEvent]:
        """Return what the desk hands over now."""
        batches, self._batches[:] = [batch() for batch in self._batches], []
        return [event for batch in batches for event in batch]

    def hands(self) -> list[HoldState]:
        return [event.state for event in self.events() if isinstance(event, Hand)]

    def take(self) -> list[Any]:
        """Let the console take what the desk hands over; return what it does."""
        (port,) = self.console.ports
        return list(port.handler(self.events(), self.at))

    def snapshot(self) -> Snapshot:
        (sent,) = self.console.timers[0].handler(self.at)
        assert isinstance(sent, Send)
        self.desk.send(sent.batch)
        return self.desk.snapshot()

    @property
    def at(self) -> Moment:
        return Moment(self.now, 1)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_what_is_heard_of_the_rig_is_shown_in_its_frames_only(bench: Bench) -> None:
    flat = tuple(np.diag([1e-8, 2e-8, 3e-8, 0.0, 0.0, 0.0]).ravel())
    bench.hear("joint_states", m.JointState(1, (m.ROTATION_JOINT, m.INSERTION_JOINT), (2.0, 0.01)))
    for frame, x in (("rig", 0.004), ("left_camera", 0.4)):
        bench.hear("target_plane", m.Pose(0, frame, (x, 0.0, 0.0), TURN))
        bench.hear("needle/tip_pose", m.PoseWithCovariance(1, frame, (x, 0.0, 0.01), TURN, flat))
    bench.hear("needle/controller_status", ControllerStatus(state="STEERING"))
    for frame, x in (("target_plane", 0.0), ("rig", 0.4)):
        estimate = m.PoseWithCovariance(1, frame, (x, 0.0, 0.01), TURN, flat)
        bench.hear("needle/estimate", estimate)
    sick = m.Status("sim_rig", "loop", Level.WARN, "slow", {})
    bench.hear("/diagnostics", m.Diagnostics(1, (sick,)))
    shown = bench.snapshot()
    assert (shown.insertion, shown.rotation) == (0.01, 2.0)
    assert shown.tip is not None
    assert shown.tip.position == pytest.approx([0.004, 0.0, 0.01])
    assert np.diag(shown.tip.covariance) == pytest.approx([1e-8, 2e-8, 3e-8])
    assert shown.T_rig_plane[:3, :3] == pytest.approx(plane_pose(0.0, 30.0)[:3, :3])
    assert shown.T_rig_plane[:3, 3] == pytest.approx([0.004, 0.0, 0.0])
    (point,) = shown.course
    assert point.position == pytest.approx([0.004 + 0.005, 0.0, 0.01 * np.sqrt(0.75)])
    assert shown.troubles == ("sim_rig: loop: slow",)
    # One that was killed while it steered must not keep the needle in.
    assert list(bench.console.on_peers(Peers(), bench.at)) == []
    assert bench.snapshot().controller is None


def test_a_whole_image_is_shown_without_what_pads_its_rows(bench: Bench) -> None:
    def shown(encoding: str, step: int, size: int) -> list[Any]:
        image = m.Image(1, "left", 2, 3, encoding, step, bytes(range(size)))
        return bench.hear("stereo/left/image_raw", image)

    (sent,) = shown("mono8", 4, 8)
    (view,) = sent.batch
    assert (view.side, view.image.tolist()) == ("left", [[0, 1, 2], [4, 5, 6]])
    for wrong in (("mono8", 4, 7), ("mono8", 2, 4), ("h264", 4, 8)):
        assert shown(*wrong) == []


def test_targets_and_lines_for_the_log_go_through(bench: Bench) -> None:
    bench.desk.send_plane(plane_pose(4.0, 30.0))
    bench.desk.send_point(target_point(10.0, -5.0, 100.0))
    bench.desk.notice("a line")
    plane, point, line = bench.take()
    assert plane.message.orientation == pytest.approx(TURN)
    assert point == Publish("target_point", m.Point(0, "rig", (0.01, -0.005, 0.1)))
    assert line == Log("warning", "a line")


def test_of_holds_that_wait_the_newest_counts_unless_one_was_a_release(bench: Bench) -> None:
    for states, counts in (
        ((RETRACT, INSERT), INSERT),
        ((INSERT, RELEASED, INSERT), RELEASED),
        ((INSERT,), INSERT),
    ):
        for state in states:
            bench.desk.hold(state)
        assert bench.hands() == [counts]
        assert bench.hands() == []


def test_a_hold_that_has_waited_for_longer_than_it_counts_is_a_release(bench: Bench) -> None:
    for share, counts in ((0.99, INSERT), (1.01, RELEASED)):
        bench.desk.hold(INSERT)
        bench.now += share * m.HOLD_LIFETIME
        assert bench.hands() == [counts]


def test_wishes_of_pages_that_nobody_takes_are_not_piled_up(bench: Bench) -> None:
    for _ in range(1000):
        bench.desk.press(Button.HOME)
    assert 0 < len(bench.events()) < 100
    assert bench.events() == []


def test_images_are_wanted_while_a_page_asks_for_views(bench: Bench) -> None:
    def listens(actions: Actions) -> dict[str, bool]:
        return {act.topic: act.on for act in actions if isinstance(act, Listen)}

    both = ("stereo/left/image_raw", "stereo/right/image_raw")
    bench.desk.picture("left")
    assert listens(bench.take()) == dict.fromkeys(both, True)
    assert {row.topic for row in bench.console.inputs if row.lazy} == {*both}
    check = bench.console.timers[1].handler
    assert listens(check(Moment(11.9, 1))) == {}
    assert listens(check(Moment(12.1, 1))) == dict.fromkeys(both, False)


def test_its_end_releases_the_hold(bench: Bench) -> None:
    release, end = bench.console.on_stop(bench.at)
    assert isinstance(release, Publish)
    assert not release.message.pressed
    assert end == Exit(0)
