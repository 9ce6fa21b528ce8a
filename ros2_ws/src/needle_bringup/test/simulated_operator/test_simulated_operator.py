"""simulated_operator: calls, holds, failures, and situations in which it must not act."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable
from typing import Any

from needle_bringup.simulated_operator.component import (
    CALL_TIMEOUT,
    DISABLE,
    ENABLE,
    HOME,
    PREPARATION,
    START,
    SimulatedOperator,
    SimulatedOperatorParameters,
)
from needle_core import messages as m
from needle_core.component import Action, Answer, Call, Exit, Moment, Peers, Publish, Send
from needle_core.diagnostics import Level
from needle_core.status_messages import ControllerStatus, DeviceStatus

CONFIRM = PREPARATION[0]
RIG, DRIVER, NAME = "/sim_rig", "/device_driver", "stand_in"
FRESH = DeviceStatus(source=RIG, simulated=True)
DISABLED = dataclasses.replace(FRESH, homed=True, state="DISABLED")
HOLDING = dataclasses.replace(DISABLED, state="HOLDING")
MOVING = dataclasses.replace(DISABLED, state="MOVING")
STEERING = ControllerStatus(state="STEERING", step=3, insertion_m=0.003, depth_m=0.12, starts=1)


def moment(now: float) -> Moment:
    return Moment(now, round(now * 1e9))


class Scene:
    """Simulated operator in a rig that the test plays."""

    def __init__(self, devices: tuple[str, ...] = (RIG,), **settings: Any) -> None:
        self.operator = SimulatedOperator(SimulatedOperatorParameters(**settings), NAME)
        self.rows = {row.topic: row.handler for row in self.operator.inputs}
        self.calls: list[Call] = []
        self.holds: list[m.HoldState] = []
        self.shown: list[ControllerStatus] = []
        self.ends: list[Exit] = []
        self.discover(devices)

    def discover(self, devices: tuple[str, ...], missing: str = "") -> None:
        topics = {"device/status": devices, "needle/controller_status": (RIG,)}
        services = frozenset(call.service for call in PREPARATION) - {missing}
        peers = Peers(topics, {"device/hold": devices}, services, frozenset({"sim_rig", NAME}))
        self.execute(self.operator.on_peers(peers, moment(0.0)))

    def execute(self, actions: Iterable[Action]) -> None:
        for action in actions:
            match action:
                case Publish():
                    self.holds.append(action.message)
                case Send():
                    self.shown += action.batch
                case Call():
                    self.calls.append(action)
                case Exit():
                    self.ends.append(action)

    def device(self, status: DeviceStatus, now: float = 1.0, **changes: Any) -> None:
        message = dataclasses.replace(status, **changes)
        self.execute(self.rows["device/status"](message, moment(now)))

    def controller(self, now: float = 2.0, **changes: Any) -> None:
        message = dataclasses.replace(STEERING, **changes)
        self.execute(self.rows["needle/controller_status"](message, moment(now)))

    def answer(self, call: Call, now: float = 1.0, text: str = "", *, success: bool = True) -> None:
        self.execute(self.operator.on_answer(Answer(call.service, success, text), moment(now)))

    def run_timer(self, now: float = 1.0) -> list[Call]:
        """Run the timer; return the calls since the last call."""
        self.execute(self.operator.timers[0].handler(moment(now)))
        calls, self.calls = self.calls, []
        return calls

    @property
    def is_held(self) -> bool:
        return bool(self.holds) and self.holds[-1].pressed

    def failure(self, now: float = 50.0) -> str:
        """Return why the run failed; the hold is released, and an enabled device disabled."""
        if self.run_timer(now):
            assert [hold.pressed for hold in self.holds[-3:]] == [False] * 3
            assert self.ends == []
            self.answer(DISABLE, now)
        (end,) = self.ends
        assert end.code in (1, 2)
        assert not self.is_held
        assert self.run_timer(now + 50.0) == []
        return end.text


def known() -> Scene:
    """Return a scene with a status of the controller, and without one of the device."""
    scene = Scene()
    scene.controller(0.0, state="IDLE", starts=0)
    return scene


def reach(wanted: Call | None = None, scene: Scene | None = None) -> Scene:
    """Return a scene just after its first attempt of a call, at 1.0 s; None: after all calls."""
    scene = scene or known()
    scene.device(DISABLED)
    for call in PREPARATION:
        assert scene.run_timer() == [call]
        assert scene.run_timer() == [], "one call at a time"
        # The device accepts a press only after a release.
        assert scene.holds
        assert not scene.is_held
        if call == wanted:
            return scene
        scene.answer(call)
    assert scene.run_timer() == []
    assert scene.is_held
    return scene


def test_a_whole_run_is_held_shown_released_and_disabled() -> None:
    scene = reach()
    scene.controller()
    held = scene.holds[-1]
    assert (held.pressed, held.source, held.speed_scale) == (True, NAME, 1.0)
    assert scene.shown == [STEERING]
    scene.controller(3.0, state="DONE", step=120, insertion_m=0.12)
    assert [hold.pressed for hold in scene.holds[-3:]] == [False] * 3
    assert (scene.calls, scene.ends) == ([DISABLE], [])
    scene.answer(DISABLE, 3.1)
    assert scene.ends == [Exit(0, "inserted 120.0 mm in 120 steps")]


def test_a_signal_releases_and_disables_before_the_end_and_a_second_one_ends_at_once() -> None:
    for is_mute in (False, True):
        scene = reach()
        scene.execute(scene.operator.on_stop(moment(2.0)))
        assert not scene.is_held
        assert (scene.calls, scene.ends) == ([DISABLE], [])
        if is_mute:
            scene.execute(scene.operator.on_stop(moment(2.1)))
        else:
            scene.answer(DISABLE, 2.1)
        assert scene.ends == [Exit(130, "interrupted")]


def test_it_waits_until_the_recorder_has_all_parameters() -> None:
    scene = Scene(wait_for_recorder=True)
    scene.device(DISABLED)
    for recorded, calls in ((f"/{NAME}", []), (f"/{NAME}, {RIG}", [CONFIRM])):
        status = m.Status("/recorder", "parameters_of", Level.OK, recorded)
        scene.execute(scene.rows["/diagnostics"](m.Diagnostics(1, (status,)), moment(1.0)))
        assert scene.run_timer() == calls


def test_it_calls_nothing_while_a_partner_is_missing() -> None:
    scene = known()
    scene.discover((RIG,), missing="device/home")
    scene.device(FRESH)
    assert scene.run_timer(89.9) == []
    assert scene.ends == []
    assert scene.run_timer(90.0) == []
    assert scene.ends == [
        Exit(2, "the rig is not ready after 90 s: missing service device/home"),
    ]


def test_what_is_missing_is_named() -> None:
    assert "no answer from device/confirm_needle_out" in reach(CONFIRM).failure(91.0)
    scene = Scene()
    scene.device(DISABLED)
    for call in PREPARATION[:-1]:
        assert scene.run_timer() == [call]
        scene.answer(call)
    # A start needs a status of the controller, to tell its own start from earlier ones.
    assert scene.run_timer() == []
    assert "no needle/controller_status received" in scene.failure(91.0)


def test_it_repeats_calls_until_the_rig_is_ready_or_refuses() -> None:
    scene = reach(CONFIRM)
    not_yet = "waiting for a subscriber of joint_states"
    scene.answer(CONFIRM, 1.0, not_yet, success=False)
    assert scene.run_timer(1.05) == []
    for now, refusal in ((20.0, not_yet), (20.2, "the needle is in"), (22.2, "the needle is in")):
        # The cause of a refusal may have changed meanwhile.
        assert scene.ends == []
        assert scene.run_timer(now) == [CONFIRM]
        scene.answer(CONFIRM, now, refusal, success=False)
    assert scene.ends == [Exit(2, "device/confirm_needle_out was refused: the needle is in")]


def test_a_call_is_repeated_if_its_answer_is_lost() -> None:
    for call, following in itertools.zip_longest(PREPARATION, PREPARATION[1:]):
        scene = reach(call)
        assert scene.run_timer(0.9 + CALL_TIMEOUT) == []
        assert scene.run_timer(1.0 + CALL_TIMEOUT) == [call]
        scene.answer(call, 2.1)
        assert scene.run_timer(2.1) == ([] if following is None else [following])
        assert scene.is_held is (following is None)
        # Answers to the earlier attempt change nothing.
        for success in (True, False):
            scene.answer(call, 2.2, "the device is MOVING", success=success)
            assert scene.run_timer(2.5) == []
            assert scene.is_held is (following is None)


def test_homing_ends_with_a_status_from_after_the_call() -> None:
    for is_answered in (True, False):
        scene = reach(HOME)
        if is_answered:
            scene.answer(HOME, 1.0, "homing")
        assert scene.run_timer() == []
        # A device may still report homed from last time while it searches for its switches.
        for homed in (False, True):
            scene.device(MOVING, 2.0, homed=homed)
            assert scene.run_timer(5.0) == []
        scene.device(DISABLED, 9.0)
        assert scene.run_timer(9.0) == [ENABLE]


def test_a_start_whose_answer_was_lost_is_known_from_the_status() -> None:
    scene = reach(START)
    for now, changes in ((1.1, {"starts": 0, "state": "IDLE"}), (1.2, {})):
        scene.controller(now, **changes)
        assert scene.run_timer(now) == []
        assert scene.is_held == (not changes)
    scene.answer(START, 1.3, "already steering", success=False)
    assert scene.run_timer(9.0) == []
    assert scene.is_held


def test_the_outcome_names_the_reason() -> None:
    for state, reason in (("FAULT", "curvature lost"), ("IDLE", "stopped by hand")):
        scene = reach()
        scene.controller()
        scene.controller(3.0, state=state, reason=reason)
        assert reason in scene.failure()
    for state in ("FAULT", "ESTOPPED"):
        scene = reach()
        scene.device(DISABLED, state=state, reason="button")
        assert "button" in scene.failure()


def test_statuses_before_the_start_are_ignored() -> None:
    for state in ("DONE", "FAULT", "IDLE"):
        scene = known()
        scene.controller(0.5, state=state)
        reach(None, scene)
        scene.controller(2.0, state=state)
        scene.controller(2.0, starts=2)
        assert scene.is_held
        scene.controller(3.0, state="DONE", starts=2)
        scene.answer(DISABLE, 3.0)
        assert [end.code for end in scene.ends] == [0]


def test_a_start_that_ends_immediately_fails_the_run() -> None:
    """STEERING, then IDLE: a latched status of depth 1 may show only the second."""
    for overtakes_answer in (False, True):
        scene = reach(START)
        if not overtakes_answer:
            scene.answer(START)
        scene.controller(1.0, state="IDLE", reason="the needle was drawn back")
        scene.answer(START)
        assert "the needle was drawn back" in scene.failure()
        assert scene.ends[0].code == 1


def test_no_progress_releases_the_hold() -> None:
    scene = reach()
    scene.controller(10.0)
    scene.controller(30.0)
    assert scene.run_timer(39.9) == []
    assert scene.is_held
    assert "no progress for 30 s at 3.0 mm" in scene.failure(40.0)


def test_an_ignored_press_is_released_and_repeated() -> None:
    scene = reach()
    for now, ignored, is_held in ((9.0, NAME, False), (9.1, "", True), (9.2, "somebody", True)):
        scene.device(HOLDING, now, press_again=ignored)
        assert scene.run_timer(now) == []
        assert scene.is_held is is_held


def test_a_real_device_ends_the_run() -> None:
    for wanted in (*PREPARATION, None):
        scene = reach(wanted)
        scene.device(DISABLED, source=DRIVER, simulated=False)
        assert f"{DRIVER} is a real device" in scene.failure()
    scene = known()
    scene.device(DISABLED, simulated=False)
    assert [end.code for end in scene.ends] == [2]
    assert (scene.run_timer(), scene.holds) == ([], [])


def test_it_acts_only_on_a_single_simulated_device() -> None:
    scene = Scene((DRIVER,))
    assert scene.run_timer() == [], "nothing is known of it yet"
    scene.device(FRESH)
    assert scene.run_timer() == [], "reported by another device"
    scene.discover((RIG, DRIVER))
    assert scene.run_timer() == []
    assert scene.ends == [], "one that was killed counts for a while"
    assert f"received it from {RIG}, {DRIVER}" in scene.failure(90.0)
    assert scene.holds == []
    scene = reach()
    scene.discover((DRIVER, RIG))
    assert f"more than one device: {DRIVER}, {RIG}" in scene.failure()
