"""The console as a component: events of pages, messages of the rig."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from needle_console.console import Console, HoldRequest, PageEvent
from needle_console.console_parameters import ConsoleParameters
from needle_console.hold.page_session import RELEASED, Mode, PageHold
from needle_console.page.page_port import PagePort
from needle_console.view.advice import Button
from needle_console.view.snapshot import Snapshot
from needle_console.view.targets import plane_pose, target_point
from needle_core import messages as m
from needle_core.component import (
    Actions,
    Answer,
    Call,
    Diagnose,
    Exit,
    Listen,
    Log,
    Moment,
    Peers,
    Publish,
    Send,
)
from needle_core.diagnostics import Level
from needle_core.status_messages import ControllerStatus, DeviceStatus

INSERT = PageHold(True, 0.5, Mode.INSERT)
RETRACT = PageHold(True, 0.5, Mode.RETRACT)
TURN = (0.0, float(np.sin(np.pi / 12)), 0.0, float(np.cos(np.pi / 12)))
"""Orientation of a plane that rises inwards by 30 degrees."""


class Bench:
    """A console and its page port, with virtual time."""

    def __init__(self) -> None:
        self.now = 10.0
        self.console = Console(ConsoleParameters())
        self.port = PagePort(ConsoleParameters(), lambda: self.now)
        self._batches: list[Any] = []
        self.port.open(self._batches.append)

    @property
    def at(self) -> Moment:
        return Moment(self.now, 1)

    def receive(self, topic: str, message: Any) -> list[Any]:
        (row,) = (row for row in self.console.inputs if row.topic == topic)
        return list(row.handler(message, self.at))

    def events(self) -> list[PageEvent]:
        """Return the waiting events of the port."""
        batches, self._batches[:] = [batch() for batch in self._batches], []
        return [event for batch in batches for event in batch]

    def handle(self, *events: PageEvent) -> list[Any]:
        """Pass events of a page to the console; return its actions."""
        (port,) = self.console.ports
        return list(port.handler(events or self.events(), self.at))

    def hold(self, *states: PageHold) -> tuple[list[m.HoldState], list[Call]]:
        """Pass holds in one batch; return the published holds, and the calls."""
        actions = self.handle(*map(HoldRequest, states))
        published = [one.message for one in actions if isinstance(one, Publish)]
        return published, [one for one in actions if isinstance(one, Call)]

    def check(self) -> list[Any]:
        """Run the check of the console; return the health and the unsubscribed topics."""
        return list(self.console.timers[1].handler(self.at))

    def snapshot(self) -> Snapshot:
        (sent,) = self.console.timers[0].handler(self.at)
        assert isinstance(sent, Send)
        self.port.send(sent.batch)
        return self.port.snapshot()


def listened(actions: Actions) -> dict[str, bool]:
    return {act.topic: act.on for act in actions if isinstance(act, Listen)}


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_hold_is_published_with_lifetime_and_release_at_once(bench: Bench) -> None:
    (first,), calls = bench.hold(INSERT)
    assert (first.source, first.pressed, first.speed_scale, calls) == ("console", True, 0.5, [])
    # As in docs/safety.md. No timer repeats it.
    assert first.lifetime == m.HOLD_LIFETIME == 0.1
    (released,), _ = bench.hold(RELEASED)
    assert (released.pressed, released.speed_scale) == (False, 0.0)
    # An earlier press of the batch does not count.
    late, _ = bench.hold(INSERT, RELEASED, INSERT)
    assert [hold.pressed for hold in late] == [False, True]
    assert [hold.count for hold in (first, released, *late)] == [1, 2, 3, 4]


def test_retraction_waits_for_the_end_of_steering(bench: Bench) -> None:
    # An ended controller does not steer.
    bench.receive("needle/controller_status", ControllerStatus(state="STEERING"))
    assert list(bench.console.on_peers(Peers(), bench.at)) == []
    assert bench.snapshot().controller is None
    for controller, owner, pressed, calls in (
        ("STEERING", "", False, [Call("plane_controller/stop")]),
        ("IDLE", "pedal", True, []),
        ("IDLE", "console", True, [Call("device/retract")]),
    ):
        bench.receive("needle/controller_status", ControllerStatus(state=controller))
        bench.receive("device/status", DeviceStatus(hold_owner=owner))
        (published,), made = bench.hold(RETRACT)
        assert (published.pressed, made) == (pressed, calls)
    # An insertion is passed on to a controller that steers.
    bench.receive("needle/controller_status", ControllerStatus(state="STEERING"))
    (published,), made = bench.hold(INSERT)
    assert (published.pressed, made) == (True, [])


def test_buttons_call_their_services_and_answers_are_shown(bench: Bench) -> None:
    for button, call in (
        (Button.CONFIRM, Call("device/confirm_needle_out", True)),
        (Button.ENABLE, Call("device/enable", True)),
        (Button.SWITCH_OFF, Call("device/enable", False)),
        (Button.STOP, Call("device/stop")),
        (Button.RESET, Call("device/reset")),
    ):
        bench.port.press(button)
        assert bench.handle() == [call]
    for answer, shown in (
        (Answer("device/home", True, "homes"), "device/home: homes"),
        (Answer("device/home", False, "not now"), "device/home: refused: not now"),
    ):
        assert list(bench.console.on_answer(answer, bench.at)) == []
        assert bench.snapshot().answer == shown


def test_silent_hold_server_is_reported(bench: Bench) -> None:
    bench.port.refusals = lambda: {"foreign Host": 3}
    for silent_for, level in ((0.9, Level.OK), (1.1, Level.ERROR)):
        bench.port.set_hold(RELEASED)
        back = [one for one in bench.handle() if isinstance(one, Diagnose)]
        # Its return is reported at once.
        assert [one.diagnostic.level for one in back] == ([Level.OK] if level == Level.OK else [])
        bench.now += silent_for
        health, *_ = bench.check()
        assert health.diagnostic.level == level
        assert health.diagnostic.values == {"refused foreign Host": "3"}


def test_growing_simulation_lag_is_reported(bench: Bench) -> None:
    for seconds, warnings in ((0.01, 0), (1.0, 1), (1.0, 0)):
        # An earlier warning is outdated.
        bench.now += 4.0
        bench.port.set_lag(seconds)
        bench.handle()
        assert len(bench.snapshot().warnings) == warnings


def test_messages_are_shown_unless_in_another_frame(bench: Bench) -> None:
    flat = tuple(np.diag([1e-8, 2e-8, 3e-8, 0.0, 0.0, 0.0]).ravel())
    joints = (m.ROTATION_JOINT, m.INSERTION_JOINT)
    bench.receive("joint_states", m.JointState(1, joints, (2.0, 0.01)))
    for frame, x in (("rig", 0.004), ("left_camera", 0.4)):
        bench.receive("target_plane", m.Pose(0, frame, (x, 0.0, 0.0), TURN))
        bench.receive("needle/tip_pose", m.PoseWithCovariance(1, frame, (x, 0.0, 0.01), TURN, flat))
    bench.receive("needle/controller_status", ControllerStatus(state="STEERING"))
    for frame, x in (("target_plane", 0.0), ("rig", 0.4)):
        estimate = m.PoseWithCovariance(1, frame, (x, 0.0, 0.01), TURN, flat)
        bench.receive("needle/estimate", estimate)
    sick = m.Status("sim_rig", "loop", Level.WARN, "slow", {})
    bench.receive("/diagnostics", m.Diagnostics(1, (sick,)))
    shown = bench.snapshot()
    assert (shown.insertion, shown.rotation) == (0.01, 2.0)
    assert shown.tip is not None
    assert shown.tip.position == pytest.approx([0.004, 0.0, 0.01])
    assert np.diag(shown.tip.covariance) == pytest.approx([1e-8, 2e-8, 3e-8])
    assert shown.T_rig_plane[:3, :3] == pytest.approx(plane_pose(0.0, 30.0)[:3, :3])
    assert shown.T_rig_plane[:3, 3] == pytest.approx([0.004, 0.0, 0.0])
    (point,) = shown.track
    assert point.position == pytest.approx([0.004 + 0.005, 0.0, 0.01 * np.sqrt(0.75)])
    turn = shown.T_rig_plane[:3, :3]
    assert turn.T @ point.covariance @ turn == pytest.approx(np.diag([1e-8, 2e-8, 3e-8]))
    assert (point.r1, point.sigma) == pytest.approx((0.0, 1e-4))
    assert shown.warnings == ("sim_rig: loop: slow",)


def test_image_is_shown_without_row_padding(bench: Bench) -> None:
    def shown(encoding: str, step: int, size: int) -> list[Any]:
        image = m.Image(1, "left", 2, 3, encoding, step, bytes(range(size)))
        return bench.receive("stereo/left/image_raw", image)

    (sent,) = shown("mono8", 4, 8)
    (view,) = sent.batch
    assert (view.side, view.image.tolist()) == ("left", [[0, 1, 2], [4, 5, 6]])
    for wrong in (("mono8", 4, 7), ("mono8", 2, 4), ("h264", 4, 8)):
        assert shown(*wrong) == []


def test_targets_and_log_lines_are_passed_on(bench: Bench) -> None:
    bench.port.send_plane(plane_pose(4.0, 30.0))
    bench.port.send_point(target_point(10.0, -5.0, 100.0))
    bench.port.log("a line")
    plane, point, line = bench.handle()
    assert plane.message.orientation == pytest.approx(TURN)
    assert point == Publish("target_point", m.Point(0, "rig", (0.01, -0.005, 0.1)))
    assert line == Log("warning", "a line")


def test_a_proposed_point_is_shown_until_it_is_withdrawn(bench: Bench) -> None:
    for frame, shown in (("rig", (0.01, -0.005, 0.1)), ("map", None)):
        assert bench.receive("needle/proposed_target", m.Point(1, frame, (0.01, -0.005, 0.1))) == []
        assert bench.snapshot().proposed_point == shown


def test_newest_waiting_hold_counts_unless_released_or_old(
    bench: Bench,
) -> None:
    for states, waited, counts in (
        ((RETRACT, INSERT), 0.99, INSERT),
        ((INSERT, RELEASED, INSERT), 0.0, RELEASED),
        ((INSERT,), 0.0, INSERT),
        ((INSERT,), 1.01, RELEASED),
    ):
        for state in states:
            bench.port.set_hold(state)
        bench.now += waited * m.HOLD_LIFETIME
        assert bench.events() == [HoldRequest(counts)]
        assert bench.events() == []


def test_images_are_subscribed_while_a_page_requests_views(bench: Bench) -> None:
    both = ("stereo/left/image_raw", "stereo/right/image_raw")
    bench.port.view("left")
    assert listened(bench.handle()) == dict.fromkeys(both, True)
    assert {row.topic for row in bench.console.inputs if row.lazy} == {*both}
    for waited, left in ((1.9, {}), (0.2, dict.fromkeys(both, False))):
        bench.now += waited
        assert listened(bench.check()[1:]) == left


def test_exit_releases_the_hold(bench: Bench) -> None:
    release, end = bench.console.on_stop(bench.at)
    assert isinstance(release, Publish)
    assert not release.message.pressed
    assert end == Exit(0)
