"""The step protocol, transition by transition, without ROS."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from needle_controller.joint_history import JointSample
from needle_controller.parameters import PlaneControllerParameters
from needle_controller.plane_control import PlaneControl
from needle_controller.steering import MOST_REFUSALS, Steering
from needle_controller.steering_types import (
    Action,
    Awaiting,
    DeviceStatus,
    Log,
    PublishUpdate,
    SendStep,
    State,
)
from needle_controller.target_plane import offset_plane, plane_from_pose
from needle_controller.tip_covariance import TipCovariance
from needle_controller.tip_gate import Fault, TipMeasurement

TICK = 20_000_000
HELD = DeviceStatus("HOLDING", True, "operator")
MOVING = DeviceStatus("MOVING", True, "operator")
FREE = DeviceStatus("HOLDING", True, "")


class Rig:
    """The other side of the protocol: joints, tips and answers, on its own clock."""

    def __init__(
        self,
        *,
        depth: float = 0.12,
        started: bool = True,
        held: bool = True,
        tip_covariance: str = "configured",
        preset: str = "best",
    ) -> None:
        parameters = PlaneControllerParameters(
            preset=preset, depth=depth, target_offset=0.003, tip_covariance=tip_covariance
        )
        control = PlaneControl(parameters.control(), offset_plane(0.003))
        self.steering = Steering(parameters.steering(), control)
        self.now = TICK
        self.insertion = 0.0
        self.rotation = 0.0
        self.steering.on_device(HELD if held else FREE)
        self.joints()
        if started:
            reply, _ = self.steering.on_start()
            assert reply.success, reply.message

    def joints(self) -> list[Action]:
        return self.steering.on_joints(JointSample(self.now, self.insertion, self.rotation))

    def measured(self, x: float = 0.0) -> TipMeasurement:
        return TipMeasurement(self.now, "rig", np.array([x, 0.0, self.insertion]))

    def expose(self, tip: TipMeasurement | None = None) -> list[Action]:
        """One tick: joints, then the tip."""
        self.now += TICK
        actions = self.joints()
        return actions + self.steering.on_tip(tip or self.measured())

    def run(self, step: SendStep, part: float = 1.0, text: str = "succeeded") -> list[Action]:
        """Carry out a part of a step and answer."""
        start = self.insertion, self.rotation
        for share in (0.5 * part, part):
            self.now += TICK
            self.insertion = start[0] + share * (step.insertion - start[0])
            self.rotation = start[1] + share * (step.rotation - start[1])
            self.joints()
        return self.steering.on_result(step.stamp_ns, text)


def sent(actions: list[Action]) -> SendStep:
    steps = [action for action in actions if isinstance(action, SendStep)]
    assert len(steps) == 1, actions
    return steps[0]


def none_sent(actions: list[Action]) -> bool:
    return not any(isinstance(action, SendStep) for action in actions)


def logged(actions: list[Action]) -> str:
    return "; ".join(action.text for action in actions if isinstance(action, Log))


def where(rig: Rig) -> tuple[State, Awaiting]:
    return rig.steering.state, rig.steering.awaiting


# IDLE


@pytest.mark.parametrize(
    ("device", "said"),
    [
        (None, "device/status"),
        (DeviceStatus("HOLDING", False, ""), "not homed"),
        (DeviceStatus("DISABLED", True, ""), "not enabled"),
        (DeviceStatus("ESTOPPED", True, ""), "not enabled"),
    ],
)
def test_start_says_why_not(device: DeviceStatus | None, said: str) -> None:
    rig = Rig(started=False)
    rig.steering._device = device
    reply, _ = rig.steering.on_start()
    assert not reply.success
    assert said in reply.message
    assert where(rig) == (State.IDLE, Awaiting.NOTHING)


def test_start_needs_joints() -> None:
    steering = Rig(started=False).steering
    fresh = Steering(steering.settings, steering.control)
    fresh.on_device(HELD)
    reply, _ = fresh.on_start()
    assert (reply.success, reply.message) == (False, "no joint_states have come")


def test_start_refuses_a_needle_it_did_not_follow() -> None:
    rig = Rig(started=False)
    rig.insertion = 0.05
    rig.now += TICK
    rig.joints()
    reply, _ = rig.steering.on_start()
    assert not reply.success
    assert "0.05 m in" in reply.message


def test_start_refuses_a_roll_its_coordinates_cannot_say() -> None:
    rig = Rig(started=False, preset="paper")
    rig.rotation = 2.0
    rig.now += TICK
    rig.joints()
    reply, _ = rig.steering.on_start()
    assert not reply.success
    assert "roll" in reply.message


@pytest.mark.parametrize("turned", [2.0, np.pi, -8.0])
def test_best_starts_with_its_base_turned_however_the_last_run_left_it(turned: float) -> None:
    rig = Rig(started=False)
    rig.rotation = turned
    rig.now += TICK
    rig.joints()
    assert rig.steering.on_start()[0].success
    assert sent(rig.expose()).rotation == pytest.approx(turned, abs=0.53)


def test_start_twice_and_stop_twice() -> None:
    rig = Rig()
    assert not rig.steering.on_start()[0].success
    assert rig.steering.on_stop()[0].success
    assert where(rig) == (State.IDLE, Awaiting.NOTHING)
    assert rig.steering.on_stop()[0].success


def test_tips_move_nothing_while_idle() -> None:
    rig = Rig(started=False)
    assert rig.expose() == []


# STEERING


def test_start_without_hold_asks_for_no_tip_until_somebody_holds() -> None:
    rig = Rig(held=False)
    assert where(rig) == (State.STEERING, Awaiting.HOLD)
    assert none_sent(rig.expose())
    assert rig.steering.on_device(HELD) == []
    assert where(rig) == (State.STEERING, Awaiting.TIP)
    # The tip seen before the hold is not used, a new one is asked for.
    assert rig.steering.tip_after_ns == rig.now
    sent(rig.expose())


def test_a_tip_leads_to_one_step() -> None:
    rig = Rig()
    assert where(rig) == (State.STEERING, Awaiting.TIP)
    actions = rig.expose()
    step = sent(actions)
    assert step.stamp_ns == rig.now
    assert step.insertion == pytest.approx(0.001)
    assert step.duration == pytest.approx(0.5)
    assert abs(step.rotation) <= np.deg2rad(30.0) + 1e-12
    # Below the plane: the needle is turned so that it bends up, towards +x.
    assert step.rotation > 0.0
    update = next(action for action in actions if isinstance(action, PublishUpdate))
    assert update.stamp_ns == rig.now
    assert update.update.estimate.reduced[0] == pytest.approx(-0.003)
    assert where(rig) == (State.STEERING, Awaiting.RESULT)
    # One tip, one step.
    assert none_sent(rig.expose())


def test_a_finished_step_asks_for_a_tip_exposed_after_its_end() -> None:
    rig = Rig()
    step = sent(rig.expose())
    assert none_sent(rig.run(step))
    end = rig.now
    assert where(rig) == (State.STEERING, Awaiting.TIP)
    assert rig.steering.step == 1
    assert rig.steering.tip_after_ns == end
    early = TipMeasurement(end - TICK // 2, "rig", np.array([0.0, 0.0, 0.0009]))
    assert rig.steering.on_tip(early) == []
    assert rig.steering.tips_rejected == 0
    assert sent(rig.expose()).insertion == pytest.approx(0.002)


def test_the_tip_asked_for_does_not_depend_on_what_arrives_first() -> None:
    """The answer may come before the last joints or after those of the next exposure."""
    steps = []
    for late in (0, 1):
        rig = Rig()
        step = sent(rig.expose())
        rig.now += TICK
        rig.insertion, rig.rotation = step.insertion, step.rotation
        rig.joints()
        if late == 0:
            rig.steering.on_result(step.stamp_ns, "succeeded")
        rig.now += TICK
        rig.joints()
        if late == 1:
            rig.steering.on_result(step.stamp_ns, "succeeded")
        steps.append(sent(rig.steering.on_tip(rig.measured())))
    assert steps[0] == steps[1]


def test_a_tip_waits_for_its_joints() -> None:
    rig = Rig()
    rig.now += TICK
    assert rig.steering.on_tip(rig.measured()) == []
    assert where(rig) == (State.STEERING, Awaiting.TIP)
    step = sent(rig.joints())
    rig.run(step)
    # Joints interpolated at the exposure, between two samples.
    rig.now += TICK
    tip = TipMeasurement(rig.now - TICK // 2, "rig", np.array([0.0, 0.0, 0.001]))
    assert rig.steering.on_tip(tip) == []
    assert sent(rig.joints()).stamp_ns == tip.stamp_ns


def test_a_step_waits_for_a_device_that_still_says_moving() -> None:
    rig = Rig()
    rig.steering.on_device(MOVING)
    assert none_sent(rig.expose())
    assert where(rig) == (State.STEERING, Awaiting.DEVICE)
    sent(rig.steering.on_device(HELD))
    assert where(rig) == (State.STEERING, Awaiting.RESULT)


def test_a_hold_lost_before_the_step_asks_for_a_fresh_tip() -> None:
    rig = Rig()
    rig.steering.on_device(MOVING)
    rig.expose()
    assert none_sent(rig.steering.on_device(FREE))
    assert where(rig) == (State.STEERING, Awaiting.HOLD)
    assert none_sent(rig.steering.on_device(HELD))
    assert where(rig) == (State.STEERING, Awaiting.TIP)
    assert rig.steering.tip_after_ns == rig.now
    sent(rig.expose())


def test_an_aborted_step_resumes_from_where_the_joints_are() -> None:
    rig = Rig()
    step = sent(rig.expose())
    rig.steering.on_device(FREE)
    rig.run(step, part=0.3, text="aborted: hold released")
    assert where(rig) == (State.STEERING, Awaiting.HOLD)
    assert rig.steering.step == 0
    assert "hold released" in rig.steering.reason
    assert none_sent(rig.expose())
    rig.steering.on_device(HELD)
    again = sent(rig.expose())
    assert again.insertion == pytest.approx(0.0003 + 0.001)


def test_answers_to_other_commands_are_not_ours() -> None:
    rig = Rig()
    step = sent(rig.expose())
    assert rig.steering.on_result(step.stamp_ns - 1, "succeeded") == []
    assert where(rig) == (State.STEERING, Awaiting.RESULT)


def test_the_last_step_ends_at_the_depth_and_then_it_is_done() -> None:
    rig = Rig(depth=0.0025)
    ends = []
    while rig.steering.state is State.STEERING:
        actions = rig.expose()
        if rig.steering.state is State.STEERING:
            step = sent(actions)
            ends.append((step.insertion, step.duration))
            rig.run(step)
    np.testing.assert_allclose(ends, [(0.001, 0.5), (0.002, 0.5), (0.0025, 0.25)])
    assert ends[-1][0] == 0.0025
    assert where(rig) == (State.DONE, Awaiting.NOTHING)
    assert rig.steering.insertion == 0.0025
    assert not rig.steering.on_start()[0].success


# Tips that are refused


@pytest.mark.parametrize(
    ("position", "frame", "said"),
    [
        ([np.nan, 0.0, 0.0], "rig", "not finite"),
        ([0.0, 0.0, 0.0], "left_camera_optical", "left_camera_optical"),
        ([0.5, 0.2, 1.0], "rig", "from the entry point"),
    ],
)
def test_a_refused_tip_moves_nothing_and_asks_for_another(
    position: list[float], frame: str, said: str
) -> None:
    rig = Rig()
    before = rig.steering.control.started
    bad = TipMeasurement(rig.now + TICK, frame, np.array(position))
    actions = rig.expose(bad)
    assert none_sent(actions)
    assert said in logged(actions)
    assert rig.steering.tips_rejected == 1
    assert said in rig.steering.reason
    assert rig.steering.control.started == before
    assert where(rig) == (State.STEERING, Awaiting.TIP)
    assert rig.steering.tip_after_ns == bad.stamp_ns
    sent(rig.expose())
    assert rig.steering.rejection == ""


def test_millimetres_are_a_jump_no_needle_makes() -> None:
    rig = Rig()
    rig.run(sent(rig.expose()))
    rig.now += TICK
    rig.joints()
    bad = TipMeasurement(rig.now, "rig", np.array([0.1, 0.0, 1.0]))
    assert "from the entry point" in logged(rig.steering.on_tip(bad))
    for _ in range(2):
        rig.run(sent(rig.expose()))
    rig.now += TICK
    rig.joints()
    bad = TipMeasurement(rig.now, "rig", np.array([0.0, 0.0, -0.0035]))
    assert "jumped" in logged(rig.steering.on_tip(bad))


def test_a_tip_that_nobody_waits_for_is_told_of_where_no_needle_can_be() -> None:
    rig = Rig()
    step = sent(rig.expose())
    assert where(rig) == (State.STEERING, Awaiting.RESULT)
    bad = TipMeasurement(rig.now + TICK // 2, "rig", np.array([0.1, 0.0, 1.0]))
    assert "from the entry point" in logged(rig.steering.on_tip(bad))
    assert rig.steering.tips_rejected == 1
    good = TipMeasurement(rig.now + TICK // 2, "rig", np.array([0.0, 0.0, 1e-3]))
    assert rig.steering.on_tip(good) == []
    rig.run(step)
    sent(rig.expose())


def test_an_old_stamp_is_refused_and_does_not_set_the_clock_back() -> None:
    rig = Rig()
    rig.run(sent(rig.expose()))
    after = rig.steering.tip_after_ns
    old = TipMeasurement(TICK, "rig", np.zeros(3))
    assert "not newer" in logged(rig.steering.on_tip(old))
    assert rig.steering.tip_after_ns == after
    sent(rig.expose())


def test_a_stamp_far_ahead_is_refused_and_does_not_block() -> None:
    rig = Rig()
    future = TipMeasurement(rig.now + 3600 * 10**9, "rig", np.zeros(3))
    assert "ahead of joint_states" in logged(rig.steering.on_tip(future))
    assert rig.steering.tip_after_ns < future.stamp_ns
    sent(rig.expose())


def test_a_tip_older_than_the_joints_kept_is_refused() -> None:
    rig = Rig()
    rig.steering.tip_after_ns = 0
    assert "older" in logged(rig.steering.on_tip(TipMeasurement(1, "rig", np.zeros(3))))


# WAITING_FOR_TIP


def test_no_tip_in_time_waits_and_a_good_one_goes_on() -> None:
    rig = Rig()
    timeout = rig.steering.settings.tip_timeout
    assert rig.steering.on_time(100.0) == []
    assert rig.steering.on_time(100.0 + 0.99 * timeout) == []
    assert where(rig) == (State.STEERING, Awaiting.TIP)
    assert "no good tip" in logged(rig.steering.on_time(100.0 + timeout))
    assert where(rig) == (State.WAITING_FOR_TIP, Awaiting.TIP)
    assert rig.steering.watchdog_trips == 1
    assert rig.steering.on_time(100.0 + 3 * timeout) == []
    bad = TipMeasurement(rig.now + TICK, "rig", np.full(3, np.nan))
    rig.expose(bad)
    assert where(rig) == (State.WAITING_FOR_TIP, Awaiting.TIP)
    sent(rig.expose())
    assert where(rig) == (State.STEERING, Awaiting.RESULT)


def test_time_does_not_run_while_a_person_pauses() -> None:
    rig = Rig(held=False)
    rig.steering.on_time(0.0)
    assert rig.steering.on_time(1e6) == []
    rig.steering.on_device(HELD)
    step = sent(rig.expose())
    rig.steering.on_device(MOVING)
    rig.steering.on_time(1e6)
    rig.joints()
    assert "nothing heard" in logged(rig.steering.on_time(2e6))
    rig.run(step)
    assert rig.steering.on_time(3e6) == []
    assert rig.steering.state is State.STEERING


def test_a_tip_whose_joints_never_come_is_given_up() -> None:
    rig = Rig()
    # Also while waiting for one already.
    for start in (0.0, 100.0):
        rig.steering.on_tip(TipMeasurement(rig.now + TICK, "rig", np.zeros(3)))
        rig.steering.on_time(start)
        assert "no joint_states" in logged(rig.steering.on_time(start + 2.0))
        rig.now += 2 * TICK
    assert rig.steering.intake.refused == {Fault.NO_JOINTS: 2}
    assert rig.steering.watchdog_trips == 3
    sent(rig.expose())


# Tips with a covariance of their own


def told(rig: Rig, std: float = 1e-4, stamp: int | None = None) -> TipCovariance:
    """What a source says of the tip exposed now."""
    return TipCovariance(rig.now if stamp is None else stamp, "rig", np.eye(3) * std**2)


def test_a_tip_waits_for_its_covariance_in_whatever_order_they_come() -> None:
    steps = []
    for order in itertools.permutations(range(3)):
        rig = Rig(tip_covariance="from_tip_pose")
        rig.now += TICK
        tip, covariance = rig.measured(0.0004), told(rig)
        actions: list[Action] = []
        for number, topic in enumerate(order):
            assert none_sent(actions), order[:number]
            actions += (
                rig.joints,
                lambda rig=rig, tip=tip: rig.steering.on_tip(tip),
                lambda rig=rig, c=covariance: rig.steering.on_tip_pose(c),
            )[topic]()
        steps.append(sent(actions))
    assert len(set(steps)) == 1


def test_the_covariance_decides_what_a_tip_is_worth() -> None:
    """A tip 2 mm off the axis: believed if it is known to 0.1 mm, hardly if only to 2 mm."""
    seen = []
    for std in (1e-4, 2e-3):
        rig = Rig(tip_covariance="from_tip_pose")
        rig.expose()
        for _ in range(4):
            rig.run(sent(rig.steering.on_tip_pose(told(rig))))
            rig.expose()
        rig.run(sent(rig.steering.on_tip_pose(told(rig))))
        rig.expose(TipMeasurement(rig.now + TICK, "rig", np.array([0.0005, 0.0, rig.insertion])))
        (update,) = (
            a for a in rig.steering.on_tip_pose(told(rig, std)) if isinstance(a, PublishUpdate)
        )
        seen.append(update.update.estimate.position[0] + 0.003)
    assert seen[0] > 3 * seen[1] > 0.0


def test_the_covariance_turns_with_the_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(tip_covariance="from_tip_pose")
    # x of this plane is y of rig.
    rig.steering.control.plane = plane_from_pose(
        "rig", [0.0, 0.003, 0.0], [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]
    )
    taken: list[Any] = []
    estimator = rig.steering.control._estimator
    correct = estimator.correct

    def spy(tip: Any, covariance: Any) -> None:
        taken.append(covariance)
        correct(tip, covariance)

    monkeypatch.setattr(estimator, "correct", spy)
    rig.expose()
    rig.run(sent(rig.steering.on_tip_pose(told(rig))))
    rig.expose()
    matrix = np.diag([1.0, 4.0, 9.0]) * 1e-8
    matrix[0, 2] = matrix[2, 0] = 1e-8
    sent(rig.steering.on_tip_pose(TipCovariance(rig.now, "rig", matrix)))
    wanted = [[4.0, 0.0, 0.0], [0.0, 1.0, -1.0], [0.0, -1.0, 9.0]]
    left_out = rig.steering.control._settings.measurement_std**2 * np.eye(3)
    np.testing.assert_allclose(taken[0], np.array(wanted) * 1e-8 + left_out, atol=1e-14)


@pytest.mark.parametrize(
    ("matrix", "frame", "said"),
    [
        (np.full((3, 3), np.nan), "rig", "not a number"),
        (np.diag([np.inf] * 3), "rig", "no tip was found"),
        (np.zeros((3, 3)), "rig", "not positive definite"),
        (-np.eye(3), "rig", "not positive definite"),
        (np.eye(3) + np.eye(3, k=1), "rig", "not symmetric"),
        (np.eye(3) * 1e-8, "map", "frame 'map'"),
    ],
)
def test_a_tip_with_a_bad_covariance_is_refused(matrix: np.ndarray, frame: str, said: str) -> None:
    rig = Rig(tip_covariance="from_tip_pose")
    rig.expose()
    actions = rig.steering.on_tip_pose(TipCovariance(rig.now, frame, matrix))
    assert none_sent(actions)
    assert said in logged(actions)
    assert rig.steering.intake.refused == {Fault.BAD_COVARIANCE: 1}
    rig.expose()
    sent(rig.steering.on_tip_pose(told(rig)))


def test_a_covariance_of_a_later_tip_says_that_the_tips_own_is_lost() -> None:
    rig = Rig(tip_covariance="from_tip_pose")
    rig.expose()
    assert rig.steering.on_tip_pose(told(rig, stamp=rig.now - TICK)) == []
    actions = rig.steering.on_tip_pose(told(rig, stamp=rig.now + TICK))
    assert "no needle/tip_pose" in logged(actions)
    assert "configured" in logged(actions)
    assert rig.steering.watchdog_trips == 0
    assert rig.steering.tip_after_ns == rig.now
    # The tip of that one is there for the next step.
    sent(rig.expose())


def test_a_source_of_tips_alone_is_told_what_to_set() -> None:
    rig = Rig(tip_covariance="from_tip_pose")
    rig.expose()
    rig.steering.on_time(0.0)
    assert rig.steering.on_time(1.9) == []
    rig.steering.on_time(2.0)
    assert rig.steering.state is State.WAITING_FOR_TIP
    assert "set it to configured" in rig.steering.reason
    assert rig.steering.intake.refused == {Fault.NO_COVARIANCE: 1}


def test_configured_noise_asks_for_no_covariance_and_uses_none() -> None:
    steps = []
    for bad in (False, True):
        rig = Rig()
        for _ in range(3):
            if bad:
                rig.steering.on_tip_pose(TipCovariance(rig.now + TICK, "rig", np.zeros((3, 3))))
            steps.append(sent(rig.expose()))
            rig.run(steps[-1])
    assert steps[:3] == steps[3:]


# A lost answer


def test_a_lost_answer_ends_in_a_fault_and_moves_nothing() -> None:
    rig = Rig()
    step = sent(rig.expose())
    timeout = rig.steering.settings.result_timeout
    # It moves for as long as it likes; the time runs from when it stands again.
    rig.steering.on_device(MOVING)
    for second in range(100):
        rig.now += TICK
        rig.joints()
        assert rig.steering.on_time(float(second)) == []
    rig.steering.on_device(HELD)
    assert rig.steering.on_time(99.0 + 0.9 * timeout) == []
    actions = rig.steering.on_time(99.0 + timeout)
    assert none_sent(actions)
    assert "no device/result for step 1" in logged(actions)
    assert where(rig) == (State.FAULT, Awaiting.NOTHING)
    assert rig.steering.watchdog_trips == 1
    assert rig.steering.on_result(step.stamp_ns, "succeeded") == []
    assert rig.expose() == []
    # A person starts it again from where the needle really is.
    rig.insertion = 0.0006
    rig.now += TICK
    rig.joints()
    assert rig.steering.on_start()[0].success
    assert sent(rig.expose()).insertion == pytest.approx(0.0016)


def test_a_slow_step_of_a_device_that_never_says_moving_is_no_lost_answer() -> None:
    rig = Rig()
    step = sent(rig.expose())
    for tenth in range(400):
        rig.now += TICK
        rig.insertion += 2.5e-6
        rig.joints()
        assert rig.steering.on_time(0.1 * tenth) == []
    rig.run(step)
    assert rig.steering.state is State.STEERING


def test_a_device_that_falls_silent_within_a_step_is_named_and_heard_again() -> None:
    rig = Rig()
    step = sent(rig.expose())
    rig.steering.on_device(MOVING)
    rig.steering.on_time(0.0)
    said = logged(rig.steering.on_time(rig.steering.settings.result_timeout))
    assert "nothing heard of the device" in said
    assert rig.steering.silence
    assert where(rig) == (State.STEERING, Awaiting.RESULT)
    assert rig.steering.on_time(1e3) == []
    rig.run(step)
    assert not rig.steering.silence
    rig.steering.on_device(HELD)
    sent(rig.expose())


def test_each_reason_to_refuse_a_tip_is_told_for_itself() -> None:
    rig = Rig()
    kinds = set()
    for position, frame in ((np.full(3, np.nan), "rig"), (np.zeros(3), "map"), (np.ones(3), "rig")):
        (log,) = rig.expose(TipMeasurement(rig.now + TICK, frame, position))
        assert isinstance(log, Log)
        kinds.add(log.kind)
    assert len(kinds) == 3
    assert rig.steering.tips_rejected == 3


# Retraction, and what the device says


def test_a_retraction_ends_steering_until_the_needle_is_out() -> None:
    rig = Rig()
    for _ in range(5):
        rig.run(sent(rig.expose()))
    rig.now += TICK
    rig.insertion -= 0.0001
    assert rig.joints() == []
    rig.now += TICK
    rig.insertion -= 0.0002
    assert "retracted" in logged(rig.joints())
    assert where(rig) == (State.IDLE, Awaiting.NOTHING)
    assert "retracted" in rig.steering.on_start()[0].message
    rig.now += TICK
    rig.insertion = 0.01
    rig.joints()
    assert not rig.steering.on_start()[0].success
    rig.now += TICK
    rig.insertion, rig.rotation = 0.0, 0.0
    rig.joints()
    assert rig.steering.on_start()[0].success
    assert sent(rig.expose()).insertion == pytest.approx(0.001)


def test_stop_and_start_go_on_with_what_is_known() -> None:
    rig = Rig()
    for _ in range(5):
        rig.run(sent(rig.expose()))
    rig.steering.on_stop()
    assert rig.steering.on_start()[0].success
    actions = rig.expose()
    assert sent(actions).insertion == pytest.approx(0.006)
    assert rig.steering.step == 5


@pytest.mark.parametrize(
    ("device", "state"),
    [
        (DeviceStatus("FAULT", True, "", "following error"), State.FAULT),
        (DeviceStatus("ESTOPPED", True, "", "pressed"), State.FAULT),
        (DeviceStatus("DISABLED", True, ""), State.IDLE),
        (DeviceStatus("UNCONFIGURED", False, ""), State.IDLE),
    ],
)
def test_a_device_that_stops_ends_steering(device: DeviceStatus, state: State) -> None:
    rig = Rig()
    step = sent(rig.expose())
    actions = rig.steering.on_device(device)
    assert where(rig) == (state, Awaiting.NOTHING)
    assert device.reason in logged(actions)
    assert rig.steering.on_result(step.stamp_ns, "aborted: stopped") == []
    assert rig.expose() == []
    rig.steering.on_device(HELD)
    assert rig.steering.on_start()[0].success


def test_commands_that_never_move_end_in_a_fault() -> None:
    rig = Rig()
    for _ in range(MOST_REFUSALS):
        assert rig.steering.state is State.STEERING
        step = sent(rig.expose())
        actions = rig.steering.on_result(step.stamp_ns, "aborted: beyond a limit")
    assert where(rig) == (State.FAULT, Awaiting.NOTHING)
    assert "beyond a limit" in logged(actions)


def test_commands_follow_data_alone() -> None:
    """Two runs over the same data, their topics interleaved differently: the same commands."""
    runs = []
    for order in (0, 1):
        rig, commands = Rig(), []
        rng = np.random.default_rng(11)
        for _ in range(30):
            rig.now += TICK
            tip = rig.measured(float(rng.uniform(-1e-3, 1e-3)))
            if order == 0:
                actions = rig.joints() + rig.steering.on_tip(tip)
            else:
                actions = rig.steering.on_tip(tip) + rig.joints()
            step = sent(actions)
            commands.append(step)
            rig.steering.on_device(MOVING)
            rig.run(step)
            rig.steering.on_device(HELD)
        runs.append(commands)
    assert runs[0] == runs[1]
