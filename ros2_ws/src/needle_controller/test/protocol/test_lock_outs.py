"""Recovery of steering from temporary faults."""

from __future__ import annotations

import numpy as np
import pytest

from needle_controller.protocol.actions import Awaiting, SteeringState
from needle_controller.protocol.joint_history import CONFIRMED_BY, JointSample
from needle_controller.protocol.tip_checks import TipFault
from needle_core.messages import Point

from .rig import MOVING, SECOND, TICK, Rig, logged, none_sent, sent, state_of

STEERING, IDLE = SteeringState.STEERING, SteeringState.IDLE


def test_the_fourth_tip_after_a_jump_is_used() -> None:
    rig = Rig()
    rig.steps(10)
    for count in range(1, 4):
        assert "jumped" in logged(rig.expose(x=0.006))
        assert rig.steering.tips.rejected == {TipFault.JUMP: count}
    rig.run(sent(rig.expose(x=0.006)))
    assert rig.steering.tips.rejected == {TipFault.JUMP: 3}
    # A tip away from the others restarts the count, and so does one at the old place.
    for _ in range(2):
        for _ in range(3):
            assert none_sent(rig.expose(x=0.0))
        assert none_sent(rig.expose(x=0.012))
    for x in (0.0, 0.0, 0.0):
        assert none_sent(rig.expose(x=x))
    assert not none_sent(rig.expose(x=0.0))


@pytest.mark.parametrize("when", ["awaited", "moving", "idle"])
@pytest.mark.parametrize("ahead_ns", [SECOND // 20, 3600 * SECOND])
def test_a_tip_with_a_future_stamp_does_not_block_steering(when: str, ahead_ns: int) -> None:
    rig = Rig()
    rig.steps(3)
    future = rig.measured(ahead=ahead_ns)
    if when == "awaited":
        assert none_sent(rig.steering.on_tip(future))
    elif when == "moving":
        step = sent(rig.expose())
        rig.steering.on_tip(future)
        rig.run(step)
    else:
        rig.steering.on_stop()
        rig.steering.on_tip(future)
        assert rig.start() == "steering"
    assert rig.good_tips().stamp_ns == rig.now
    assert rig.steering.tips.after_ns <= rig.now


def test_the_stamp_of_a_rejected_tip_counts_up_to_a_tenth_of_a_second_ahead() -> None:
    for ahead, believed in ((99_000_000, True), (101_000_000, False)):
        rig = Rig()
        before = rig.steering.tips.after_ns
        nowhere = Point(rig.now + ahead, "rig", (np.nan,) * 3)
        rig.steering.on_tip(nowhere)
        assert rig.steering.tips.after_ns == (nowhere.stamp_ns if believed else before)


def test_a_full_queue_keeps_the_newest_tips() -> None:
    rig = Rig()
    first = rig.now
    for k in range(1, 80):
        rig.steering.on_tip(rig.measured(ahead=k * TICK // 2))
        # A repeated tip changes nothing.
        rig.steering.on_tip(rig.measured(ahead=k * TICK // 2))
    rig.now += 39 * TICK
    step = sent(rig.joints())
    assert step.stamp_ns == first + 16 * TICK // 2
    assert rig.steering.tips.rejected.total() == 0


def test_inconsistent_joints_are_logged_once() -> None:
    rig = Rig()
    logs = [rig.steering.on_joints(JointSample(rig.now + k, 0.05, 0.0)) for k in (1, 2, 3)]
    assert [len(log) for log in logs] == [1, 0, 0]


def test_a_repeated_joint_sample_does_not_end_the_silence_of_the_device() -> None:
    rig = Rig()
    rig.expose()
    rig.steering.on_device(MOVING)
    rig.steering.on_time(0.0)
    rig.joints()
    assert "no message from the device" in logged(rig.steering.on_time(10.0))


@pytest.mark.parametrize(
    ("off", "turned", "is_back"),
    [(1.9e-4, 0.099, True), (2.1e-4, 0.0, False), (0.0, 0.101, False)],
)
def test_after_a_joint_jump_the_needle_must_be_out_or_back(
    off: float, turned: float, is_back: bool
) -> None:
    rig = Rig()
    rig.steps(15)
    deep = rig.insertion
    rig.insertion = 0.005
    assert "IDLE: joint_states jumped from 0.01" in logged(rig.settle(CONFIRMED_BY))
    assert state_of(rig) == (IDLE, Awaiting.NOTHING)
    assert "withdraw the needle" in rig.start()
    rig.insertion, rig.rotation = deep - off, rig.rotation - turned
    assert ("joint_states are back" in logged(rig.settle(CONFIRMED_BY))) is is_back
    assert (rig.start() == "steering") is is_back
    rig.steering.on_stop()
    rig.withdraw()
    assert rig.start() == "steering"
    assert rig.good_tips().insertion == pytest.approx(0.001)


def test_steering_stops_when_the_clock_is_set_back_and_can_restart() -> None:
    rig = Rig()
    rig.now += 100 * SECOND
    rig.settle()
    assert rig.start() == "already steering"
    rig.steps(5)
    rig.now -= 50 * SECOND
    assert "IDLE: the clock of joint_states went -49.9 s" in logged(rig.settle(CONFIRMED_BY))
    assert rig.start() == "steering"
    rig.run(rig.good_tips())
    assert rig.steering.step == 6


@pytest.mark.parametrize(
    ("moved", "continues"), [(1.19e-3, True), (-1.9e-4, True), (1.21e-3, False)]
)
def test_steering_continues_after_a_gap_in_joint_states(moved: float, continues: bool) -> None:
    rig = Rig()
    rig.steps(5)
    rig.now += 100 * SECOND
    rig.insertion += moved
    rig.settle(CONFIRMED_BY)
    assert (rig.steering.state is STEERING) is continues
    if continues:
        rig.good_tips()
