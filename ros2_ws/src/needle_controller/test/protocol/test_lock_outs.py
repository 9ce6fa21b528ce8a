"""What is wrong for a while, or once, and how steering goes on from it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from needle_controller.protocol.joint_history import CONFIRMED_BY, JointSample
from needle_controller.protocol.steering_types import Action, Awaiting, SendStep, SteeringState
from needle_controller.protocol.step_watch import MOST_UNFOLLOWED
from needle_controller.protocol.tip_gate import Fault, TipMeasurement

from .rig import HELD, TICK, Rig, logged, none_sent, sent, where

SECOND = 10**9
ENOUGH = 5


def steps(rig: Rig, count: int) -> None:
    for _ in range(count):
        rig.run(sent(rig.expose()))


def good_tips(rig: Rig, most: int = ENOUGH) -> SendStep:
    """Expose good tips until one leads to a step."""
    for _ in range(most):
        actions = rig.expose()
        if not none_sent(actions):
            return sent(actions)
    raise AssertionError(f"{most} good tips, no step: {where(rig)} {rig.steering.reason}")


def shifted(rig: Rig, x: float) -> TipMeasurement:
    return TipMeasurement(rig.now + TICK, "rig", np.array([x, 0.0, rig.insertion]))


def test_two_bad_tips_in_a_row_do_not_lock_the_good_ones_out() -> None:
    rig = Rig()
    steps(rig, 20)
    for x in (0.0045, 0.009):
        rig.run(sent(rig.expose(shifted(rig, x))))
    rig.run(good_tips(rig))
    assert rig.steering.intake.refused[Fault.JUMP] == ENOUGH - 2
    steps(rig, 5)


@pytest.mark.parametrize("bad", [2, 5])
def test_stop_and_start_after_bad_tips_goes_on_from_good_ones(bad: int) -> None:
    rig = Rig()
    steps(rig, 20)
    for _ in range(bad):
        actions = rig.expose(shifted(rig, 0.0045))
        if not none_sent(actions):
            rig.run(sent(actions))
    rig.steering.on_stop()
    assert rig.steering.on_start()[0].success
    rig.run(good_tips(rig))
    steps(rig, 5)


def test_a_needle_that_goes_in_farther_than_its_stage_is_steered_to_the_end() -> None:
    rig = Rig()
    while rig.insertion < 0.119:
        tip = np.array([0.0, 0.0, 1.06 * rig.insertion])
        rig.run(sent(rig.expose(TipMeasurement(rig.now + TICK, "rig", tip))))
    assert rig.steering.intake.refused.total() == 0


def test_single_tips_far_off_are_refused_each() -> None:
    rig = Rig()
    steps(rig, 20)
    for _ in range(3 * ENOUGH):
        assert none_sent(rig.expose(shifted(rig, 0.01)))
        steps(rig, 1)


@pytest.mark.parametrize("frozen", [5, 8, 12])
def test_a_camera_that_froze_and_goes_on(frozen: int) -> None:
    rig = Rig()
    steps(rig, 10)
    at = np.array([0.0, 0.0, rig.insertion])
    for _ in range(frozen):
        actions = rig.expose(TipMeasurement(rig.now + TICK, "rig", at))
        if not none_sent(actions):
            rig.run(sent(actions))
    rig.run(good_tips(rig))
    steps(rig, 5)


@pytest.mark.parametrize("ahead", [0.05, 0.5, 0.99, 1.5, 3600.0])
@pytest.mark.parametrize("when", ["wanted", "moving", "idle"])
def test_one_tip_from_the_future_holds_nothing_up(ahead: float, when: str) -> None:
    rig = Rig()
    steps(rig, 3)
    future = TipMeasurement(
        rig.now + round(ahead * SECOND), "rig", np.array([0.0, 0.0, rig.insertion])
    )
    if when == "wanted":
        assert none_sent(rig.steering.on_tip(future))
    elif when == "moving":
        step = sent(rig.expose())
        rig.steering.on_tip(future)
        rig.run(step)
    else:
        rig.steering.on_stop()
        rig.steering.on_tip(future)
        assert rig.steering.on_start()[0].success
    step = good_tips(rig)
    assert step.stamp_ns == rig.now
    assert rig.steering.intake.after_ns <= rig.now


def test_stop_and_start_after_any_of_them_wants_no_tip_of_the_future() -> None:
    rig = Rig()
    steps(rig, 3)
    rig.steering.on_tip(TipMeasurement(rig.now + 3600 * SECOND, "rig", np.zeros(3)))
    assert rig.steering.intake.refused == {Fault.AHEAD_OF_JOINTS: 1}
    rig.steering.on_stop()
    assert rig.steering.on_start()[0].success
    good_tips(rig, 1)


@pytest.mark.parametrize(
    "spike",
    [
        (0, -0.01, 0.0),
        (0, 0.01, 0.0),
        (0, -0.0006, 0.0),
        (0, 0.0006, 0.0),
        (0, 0.0, 2.0),
        (3600 * SECOND, 0.0, 0.0),
    ],
)
@pytest.mark.parametrize("when", ["wanted", "moving"])
def test_a_spike_in_joint_states_stops_nothing(spike: tuple[int, float, float], when: str) -> None:
    rig = Rig()
    steps(rig, 15)
    step = sent(rig.expose()) if when == "moving" else None
    ahead, insertion, rotation = spike
    rig.now += TICK
    rig.steering.on_joints(
        JointSample(rig.now + ahead, rig.insertion + insertion, rig.rotation + rotation)
    )
    if step is not None:
        rig.run(step)
    assert rig.steering.state is SteeringState.STEERING
    rig.run(good_tips(rig))
    steps(rig, 5)
    assert rig.steering.state is SteeringState.STEERING


def test_joints_that_jumped_and_came_back_need_no_drawing_out() -> None:
    rig = Rig()
    steps(rig, 15)
    deep = rig.insertion
    rig.insertion = 0.005
    assert "jumped from 0.015 m" in logged(rig.settle(CONFIRMED_BY))
    assert where(rig) == (SteeringState.IDLE, Awaiting.NOTHING)
    assert "draw the needle out" in rig.steering.on_start()[0].message
    rig.insertion = deep
    rig.settle(CONFIRMED_BY)
    assert rig.steering.on_start()[0].success
    rig.run(good_tips(rig))
    assert rig.steering.step == 16


def test_joints_that_jumped_for_good_want_the_needle_out() -> None:
    rig = Rig()
    steps(rig, 15)
    rig.insertion = 0.005
    rig.settle(CONFIRMED_BY)
    while rig.insertion > 0.0:
        if rig.insertion > rig.steering.settings.needle_out_insertion:
            assert not rig.steering.on_start()[0].success
        rig.insertion = max(rig.insertion - 0.0005, 0.0)
        rig.settle(1)
    rig.settle()
    assert rig.steering.on_start()[0].success
    assert good_tips(rig).insertion == pytest.approx(0.001)


def test_a_clock_that_went_back_is_a_stop_and_a_start() -> None:
    rig = Rig()
    rig.now += 100 * SECOND
    rig.settle()
    assert rig.steering.on_start()[0].message == "already steering"
    steps(rig, 5)
    rig.now -= 50 * SECOND
    assert "clock" in logged(rig.settle(CONFIRMED_BY))
    assert where(rig) == (SteeringState.IDLE, Awaiting.NOTHING)
    assert rig.steering.on_start()[0].success
    rig.run(good_tips(rig))
    assert rig.steering.step == 6


def test_joints_that_were_silent_go_on() -> None:
    rig = Rig()
    steps(rig, 5)
    rig.now += 100 * SECOND
    rig.settle(CONFIRMED_BY)
    assert rig.steering.state is SteeringState.STEERING
    good_tips(rig)


@pytest.mark.parametrize("share", [0.0, 0.9])
def test_steps_that_the_joints_do_not_follow_are_a_fault(share: float) -> None:
    rig = Rig()
    steps(rig, 3)
    count = 0
    while rig.steering.state is SteeringState.STEERING:
        rig.run(good_tips(rig), part=share)
        said = logged(rig.settle())
        count += 1
        assert count <= MOST_UNFOLLOWED
    assert count == MOST_UNFOLLOWED
    assert "said to have succeeded" in said
    assert where(rig) == (SteeringState.FAULT, Awaiting.NOTHING)
    assert rig.steering.step == 3
    # A person has looked after it.
    assert rig.steering.on_start()[0].success
    rig.run(good_tips(rig))
    assert rig.steering.step == 4


def test_a_step_that_was_followed_forgets_those_that_were_not() -> None:
    rig = Rig()
    for _ in range(2 * MOST_UNFOLLOWED):
        rig.run(good_tips(rig), part=0.5)
        rig.settle()
        rig.run(good_tips(rig))
    assert rig.steering.state is SteeringState.STEERING


def test_nothing_is_sent_from_a_tip_exposed_before_the_last_motion() -> None:
    """Whatever order answer, tips and joints of a step arrive in: the same command follows."""
    after = set()
    for order in itertools.permutations(range(4)):
        rig = Rig()
        steps(rig, 3)
        step = sent(rig.expose())
        start = rig.insertion, rig.rotation
        # Before the motion, in its midst and after it.
        tips, joints = [], []
        for share in (0.0, 0.0, 0.4, 0.8, 1.0, 1.0, 1.0):
            rig.now += TICK
            rig.insertion = start[0] + share * (step.insertion - start[0])
            rig.rotation = start[1] + share * (step.rotation - start[1])
            joints.append(JointSample(rig.now, rig.insertion, rig.rotation))
            tips.append(rig.measured())
        if order.index(2) > order.index(3):
            # A topic keeps its order.
            continue
        actions: list[Action] = []
        for event in order:
            if event == 0:
                actions += rig.steering.on_result(step.stamp_ns, "succeeded")
            elif event == 1:
                for tip in tips:
                    actions += rig.steering.on_tip(tip)
            else:
                for sample in joints[:3] if event == 2 else joints[3:]:
                    actions += rig.steering.on_joints(sample)
        after.add(sent(actions))
    (command,) = after
    assert command.stamp_ns == tips[5].stamp_ns


def test_a_result_before_the_motions_end_turns_no_more_than_its_share() -> None:
    rig = Rig()
    steps(rig, 3)
    step = sent(rig.expose())
    start = rig.insertion, rig.rotation
    rig.steering.on_result(step.stamp_ns, "succeeded")
    for share in np.linspace(0.1, 0.9, 9):
        rig.insertion = start[0] + share * (step.insertion - start[0])
        rig.rotation = start[1] + share * (step.rotation - start[1])
        assert none_sent(rig.expose())
    rig.insertion, rig.rotation = step.insertion, step.rotation
    following = good_tips(rig)
    turned = abs(following.rotation - rig.rotation) / (following.insertion - rig.insertion)
    assert turned <= np.deg2rad(30.0) / 1e-3 + 1e-6


def test_a_needle_that_moves_by_itself_is_looked_at_anew() -> None:
    rig = Rig()
    steps(rig, 3)
    rig.now += TICK
    rig.steering.on_tip(rig.measured())
    # Heard together: joints at the exposure, and those of a motion nobody asked for.
    rig.joints()
    rig.steering.on_stop()
    rig.steering.on_start()
    rig.steering.on_device(HELD)
    early = rig.measured()
    rig.now += TICK
    moved = JointSample(rig.now, rig.insertion + 0.0005, rig.rotation)
    rig.steering.on_joints(moved)
    assert none_sent(rig.steering.on_tip(early))
    rig.insertion += 0.0005
    assert sent(rig.expose()).insertion == pytest.approx(rig.insertion + 0.001)
