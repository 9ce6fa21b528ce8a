"""Steps of the protocol."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from needle_controller.presets.own_parts import OwnPartError
from needle_controller.protocol import steering
from needle_controller.protocol.actions import (
    Action,
    Awaiting,
    PublishUpdate,
    SendStep,
    SteeringState,
)
from needle_controller.protocol.confidence import Confidence
from needle_controller.protocol.joint_history import JointSample

from .rig import FREE, HOLD, MOVING, TICK, Rig, logged, none_sent, sent, state_of

STEERING = SteeringState.STEERING


def test_a_tip_leads_to_one_step_and_its_end_awaits_another() -> None:
    rig = Rig()
    assert state_of(rig) == (STEERING, Awaiting.TIP)
    actions = rig.expose()
    step = sent(actions)
    assert (step.stamp_ns, rig.steering.command_ns) == (rig.now, rig.now)
    assert (step.insertion, step.duration) == pytest.approx((0.001, 0.5))
    # Below the plane the needle is turned to bend towards +x.
    assert 0.0 < step.rotation <= np.deg2rad(30.0) + 1e-12
    (update,) = (action for action in actions if isinstance(action, PublishUpdate))
    assert update.stamp_ns == rig.now
    assert update.update.estimate.reduced[0] == pytest.approx(-0.003)
    assert rig.steering.reach is update.update.reach
    assert none_sent(rig.expose())
    # Answers to other commands are ignored.
    assert rig.steering.on_result(step.stamp_ns - 1, "succeeded") == []
    assert state_of(rig) == (STEERING, Awaiting.RESULT)
    assert none_sent(rig.run(step))
    assert state_of(rig) == (STEERING, Awaiting.TIP)
    assert (rig.steering.step, rig.steering.tips.after_ns) == (1, rig.now)
    # A tip exposed before the end is neither used nor rejected.
    assert rig.steering.on_tip(rig.measured(ahead=-TICK // 2)) == []
    assert rig.steering.tips.rejected.total() == 0
    assert sent(rig.expose()).insertion == pytest.approx(0.002)


def test_without_hold_no_tip_is_used_and_after_it_a_fresh_one() -> None:
    rig = Rig(held=False)
    for _ in range(2):
        assert state_of(rig) == (STEERING, Awaiting.HOLD)
        assert none_sent(rig.expose())
        assert rig.steering.on_device(HOLD) == []
        assert state_of(rig) == (STEERING, Awaiting.TIP)
        assert rig.steering.tips.after_ns == rig.now
        # A step is held back until the device stops moving; a release discards it.
        rig.steering.on_device(MOVING)
        assert none_sent(rig.expose())
        assert state_of(rig) == (STEERING, Awaiting.DEVICE)
        assert none_sent(rig.steering.on_device(FREE))
    rig.steering.on_device(MOVING)
    rig.expose()
    sent(rig.steering.on_device(HOLD))
    assert state_of(rig) == (STEERING, Awaiting.RESULT)


def test_an_aborted_step_resumes_from_where_the_joints_are() -> None:
    rig = Rig()
    rig.steps(3)
    step = sent(rig.expose())
    rig.steering.on_device(FREE)
    actions = rig.run(step, part=0.3, text="aborted: hold released")
    assert logged(actions) == "step 4 aborted: hold released"
    assert state_of(rig) == (STEERING, Awaiting.HOLD)
    assert rig.steering.step == 3
    assert rig.steering.reason == "step aborted: hold released"
    assert none_sent(rig.expose())
    rig.steering.on_device(HOLD)
    assert sent(rig.expose()).insertion == pytest.approx(0.0033 + 0.001)


@pytest.mark.parametrize("answered_ns", [0, 10**18])
def test_a_step_may_end_after_its_answer(answered_ns: int) -> None:
    """Joints that move, or were sent before the answer, do not show a standstill."""
    rig = Rig()
    step = sent(rig.expose())
    rig.steering.on_result(step.stamp_ns, "succeeded", answered_ns)
    for _ in range(10):
        rig.insertion += 0.0 if answered_ns else 2.1e-6
        assert rig.settle(1) == []
    assert none_sent(rig.steering.on_tip(rig.measured()))
    rig.insertion, rig.rotation = step.insertion, step.rotation
    rig.settle(1)
    assert (rig.steering.step, rig.steering.tips.after_ns) == (1, rig.now)


def test_the_command_does_not_depend_on_the_order_of_topics() -> None:
    """Answer, tips and joints of a step arrive in any order of the topics."""
    after = set()
    for order in set(itertools.permutations(("answer", "tips", "joints", "joints"))):
        rig = Rig()
        rig.steps(3)
        step = sent(rig.expose())
        start = rig.insertion, rig.rotation
        tips, joints = [], []
        for share in (0.0, 0.0, 0.4, 0.8, 1.0, 1.0, 1.0):
            rig.now += TICK
            rig.go_to(start, step, share)
            joints.append(JointSample(rig.now, rig.insertion, rig.rotation))
            tips.append(rig.measured())
        actions: list[Action] = []
        halves = iter((joints[:3], joints[3:]))
        for topic in order:
            if topic == "answer":
                actions += rig.steering.on_result(step.stamp_ns, "succeeded")
            elif topic == "tips":
                for tip in tips:
                    actions += rig.steering.on_tip(tip)
            else:
                for sample in next(halves):
                    actions += rig.steering.on_joints(sample)
        after.add(sent(actions))
    (command,) = after
    # The first tip of the needle at rest, not one exposed before or during the motion.
    assert command.stamp_ns == tips[5].stamp_ns


@pytest.mark.parametrize("waits_for_device", [False, True])
@pytest.mark.parametrize(
    ("moved", "turned", "is_outdated"),
    [(1.01e-4, 0.0, True), (0.99e-4, 0.0, False), (0.0, 2.1e-2, True), (0.0, -1.9e-2, False)],
)
def test_motion_since_the_exposure_requires_a_new_tip(
    waits_for_device: bool, moved: float, turned: float, is_outdated: bool
) -> None:
    rig = Rig()
    rig.steps(3)
    rig.settle(1)
    tip, last = rig.measured(), rig.steering.tips.last
    if waits_for_device:
        rig.steering.on_device(MOVING)
        rig.steering.on_tip(tip)
    rig.insertion += moved
    rig.rotation += turned
    rig.settle(1)
    actions = rig.steering.on_device(HOLD) if waits_for_device else rig.steering.on_tip(tip)
    assert none_sent(actions) is is_outdated
    if is_outdated:
        # A tip that comes too late does not become the last used one.
        assert (rig.steering.tips.last is last) is not waits_for_device
        assert state_of(rig) == (STEERING, Awaiting.TIP)
        assert sent(rig.expose()).insertion == pytest.approx(rig.insertion + 0.001)


def test_the_last_step_ends_at_the_depth() -> None:
    rig = Rig(depth=0.0025)
    for end, duration in ((0.001, 0.5), (0.002, 0.5), (0.0025, 0.25)):
        step = sent(rig.expose())
        assert (step.insertion, step.duration) == pytest.approx((end, duration))
        rig.run(step)
    rig.expose()
    assert rig.steering.insertion == 0.0025
    assert state_of(rig) == (SteeringState.DONE, Awaiting.NOTHING)
    # The reason contains the confidence: the needle ends away from the plane.
    assert "insertion 0.0025 m reached; r1 = " in rig.steering.reason
    assert "m (95 %), doubtful: " in rig.steering.reason
    assert "reached the depth" in rig.start()


def test_an_uncertain_estimate_halves_the_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        steering, "assess_confidence", lambda *_: Confidence("doubtful", is_doubtful=True)
    )
    assert sent(Rig().expose()).duration == pytest.approx(1.0)


def test_a_recorded_step_replaces_the_sent_one() -> None:
    rig = Rig()
    rig.steering.on_recorded_step(5, JointSample(0, 0.0, 0.0))
    assert rig.steering.on_result(5, "succeeded") == []
    step = sent(rig.expose())
    other = JointSample(0, step.insertion - 0.0004, step.rotation)
    rig.steering.on_recorded_step(step.stamp_ns + 1, other)
    assert rig.steering.on_result(step.stamp_ns, "succeeded") == []
    rig.run(SendStep(step.stamp_ns + 1, other.insertion, other.rotation, 0.5))
    assert (rig.steering.step, rig.steering.tips.after_ns) == (1, rig.now)


def test_a_failing_part_of_another_package_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OwnPartError("advance() raised RuntimeError")

    rig = Rig()
    with monkeypatch.context() as broken:
        broken.setattr(rig.steering.control, "update", fail)
        assert logged(rig.expose()) == "FAULT: advance() raised RuntimeError"
    assert state_of(rig) == (SteeringState.FAULT, Awaiting.NOTHING)
    assert none_sent(rig.expose())
    assert rig.start() == "steering"
    sent(rig.expose())
