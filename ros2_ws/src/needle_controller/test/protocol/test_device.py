"""Answers of the device, missing answers, and retraction."""

from __future__ import annotations

import pytest

from needle_controller.protocol.actions import Awaiting, SteeringState
from needle_controller.protocol.motion_monitors import MAX_ABORTS_AT_REST, MAX_UNFOLLOWED_STEPS

from .rig import FREE, HOLD, MOVING, TICK, Rig, device, logged, none_sent, sent, state_of

IDLE, FAULT = SteeringState.IDLE, SteeringState.FAULT
NOTHING = Awaiting.NOTHING


def test_a_lost_answer_is_a_fault_without_motion() -> None:
    rig = Rig()
    step = sent(rig.expose())
    timeout = rig.steering.settings.result_timeout
    # The timeout starts when the motion ends.
    rig.steering.on_device(MOVING)
    for second in range(100):
        rig.settle(1)
        assert rig.steering.on_time(float(second)) == []
    rig.steering.on_device(HOLD)
    assert rig.steering.on_time(99.0 + 0.99 * timeout) == []
    actions = rig.steering.on_time(99.0 + timeout)
    assert none_sent(actions)
    assert "no device/result for step 1 in 10 s" in logged(actions)
    assert state_of(rig) == (FAULT, NOTHING)
    assert rig.steering.watchdog_trips == 1
    assert rig.steering.on_result(step.stamp_ns, "succeeded") == []
    assert rig.expose() == []
    # A new start continues from the actual position.
    rig.insertion = 0.0006
    rig.settle(1)
    assert rig.start() == "steering"
    assert sent(rig.expose()).insertion == pytest.approx(0.0016)


def test_a_slow_step_without_status_moving_is_not_a_lost_answer() -> None:
    rig = Rig()
    step = sent(rig.expose())
    for tenth in range(400):
        rig.insertion += 2.5e-6
        rig.settle(1)
        assert rig.steering.on_time(0.1 * tenth) == []
    rig.run(step)
    assert rig.steering.state is SteeringState.STEERING


def test_silence_of_the_device_and_its_end_are_logged() -> None:
    rig = Rig()
    for by_joints in (True, False):
        step = sent(rig.expose())
        rig.steering.on_device(MOVING)
        rig.steering.on_time(0.0)
        assert rig.steering.on_time(9.9) == []
        assert "no message from the device for 10 s" in logged(rig.steering.on_time(10.0))
        assert rig.steering.watchdog.silence
        assert state_of(rig) == (SteeringState.STEERING, Awaiting.RESULT)
        assert rig.steering.on_time(1e3) == []
        actions = rig.settle(1) if by_joints else rig.steering.on_device(MOVING)
        assert "sends messages again" in logged(actions)
        assert not rig.steering.watchdog.silence
        rig.steering.on_device(HOLD)
        rig.run(step)
        rig.steering.on_time(2e3)
    # The silence is cleared at the end of a run.
    rig.expose()
    rig.steering.on_device(MOVING)
    rig.steering.on_time(0.0)
    rig.steering.on_time(10.0)
    rig.steering.on_stop()
    assert not rig.steering.watchdog.silence


def test_a_retraction_ends_steering_until_the_needle_is_out() -> None:
    rig = Rig()
    rig.steps(5)
    rig.settle()
    rig.insertion -= 0.00019
    assert rig.settle() == []
    rig.insertion -= 0.00002
    assert "IDLE: needle retracted to 0.00479 m" in logged(rig.settle())
    assert state_of(rig) == (IDLE, NOTHING)
    assert not rig.steering.control.started
    assert rig.steering.tips.last is None
    rig.insertion = 0.004
    rig.settle()
    assert "retracted: withdraw it first" in rig.start()
    while rig.insertion > 0.0:
        rig.insertion = max(rig.insertion - 0.0005, 0.0)
        # The retraction is logged once.
        assert rig.settle(1) == []
    rig.settle()
    assert rig.start() == "steering"
    assert sent(rig.expose()).insertion == pytest.approx(0.001)


def test_a_device_that_stops_ends_steering() -> None:
    for status, state, severity in (
        (device("FAULT", reason="following error"), FAULT, "error"),
        (device("ESTOPPED", reason="pressed"), FAULT, "error"),
        (device("DISABLED"), IDLE, "warning"),
        (device("UNCONFIGURED", False), IDLE, "warning"),
    ):
        rig = Rig()
        step = sent(rig.expose())
        (log,) = rig.steering.on_device(status)
        assert state_of(rig) == (state, NOTHING)
        assert getattr(log, "severity", "") == severity
        text = logged([log])
        assert f"{state.value}: device is {status.state}" in text
        assert status.reason in text
        assert rig.steering.on_result(step.stamp_ns, "aborted: stopped") == []
        assert rig.expose() == []
        rig.steering.on_device(HOLD)
        assert rig.start() == "steering"


def test_commands_without_motion_are_a_fault_and_a_start_resets_the_count() -> None:
    rig = Rig()
    rig.steps(1)
    for _ in range(2):
        for _ in range(MAX_ABORTS_AT_REST):
            assert rig.steering.state is SteeringState.STEERING
            step = sent(rig.expose())
            actions = rig.steering.on_result(step.stamp_ns, "aborted: beyond a limit")
        assert state_of(rig) == (FAULT, NOTHING)
        assert "10 commands in a row ended without motion" in logged(actions)
        assert "beyond a limit" in logged(actions)
        assert rig.start() == "steering"
    # A command with a little motion resets the count.
    for _ in range(3):
        rig.run(sent(rig.expose()), part=0.01, text="aborted: slow")
        for _ in range(MAX_ABORTS_AT_REST - 1):
            rig.steering.on_result(sent(rig.expose()).stamp_ns, "aborted: no")
        assert rig.steering.state is SteeringState.STEERING


def test_repeated_releases_are_not_a_fault() -> None:
    rig = Rig()
    for _ in range(2 * MAX_ABORTS_AT_REST):
        step = sent(rig.expose())
        rig.steering.on_result(step.stamp_ns, "aborted: hold released")
        rig.steering.on_device(FREE)
        rig.steering.on_device(HOLD)
    assert state_of(rig) == (SteeringState.STEERING, Awaiting.TIP)


def test_unfollowed_steps_are_a_fault() -> None:
    for share in (0.0, 0.9):
        rig = Rig()
        rig.steps(3)
        for count in range(1, MAX_UNFOLLOWED_STEPS + 1):
            assert rig.steering.state is SteeringState.STEERING
            rig.run(rig.good_tips(), part=share)
            text = logged(rig.settle())
            assert "device/result reports success" in text
            assert ("3 times in a row" in text) is (count == MAX_UNFOLLOWED_STEPS)
        assert state_of(rig) == (FAULT, NOTHING)
        assert rig.steering.step == 3
        # A start resets the count.
        assert rig.start() == "steering"
        rig.run(rig.good_tips())
        assert rig.steering.step == 4


def test_a_followed_step_resets_the_count_of_unfollowed_ones() -> None:
    rig = Rig()
    for _ in range(MAX_UNFOLLOWED_STEPS + 1):
        rig.run(rig.good_tips(), part=0.5)
        rig.settle()
        assert "device/result reports success" in rig.steering.reason
        assert rig.steering.tips.after_ns <= rig.now - TICK
        rig.run(rig.good_tips())
    assert rig.steering.state is SteeringState.STEERING
