"""Answers of the device, missing answers, and retraction."""

from __future__ import annotations

import pytest

from needle_controller.protocol.actions import Action, Awaiting, SteeringState
from needle_controller.protocol.motion_monitors import MAX_ABORTS_AT_REST, MAX_UNFOLLOWED_STEPS

from .rig import FREE, HOLD, MOVING, Rig, device, logged, sent, state_of

IDLE, FAULT = SteeringState.IDLE, SteeringState.FAULT
NOTHING = Awaiting.NOTHING


def test_a_lost_answer_is_a_fault_without_motion() -> None:
    rig = Rig()
    rig.steps(3)
    step = sent(rig.expose())
    timeout = rig.steering.settings.result_timeout
    # The timeout starts when the motion ends.
    rig.steering.on_device(MOVING)
    for second in range(100):
        rig.settle(1)
        assert rig.steering.on_time(float(second)) == []
    rig.steering.on_device(HOLD)
    assert rig.steering.on_time(99.0 + 0.99 * timeout) == []
    (log,) = rig.steering.on_time(99.0 + timeout)
    assert "no device/result for step 4 in 10 s" in logged([log])
    assert state_of(rig) == (FAULT, NOTHING)
    assert rig.steering.watchdog_trips == 1
    assert rig.steering.on_result(step.stamp_ns, "succeeded") == rig.expose() == []
    # A new start continues from the actual position.
    rig.insertion += 0.0006
    rig.settle(1)
    assert rig.start() == "steering"
    assert sent(rig.expose()).insertion == pytest.approx(0.0046)


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
        rig.expose()
        rig.steering.on_device(MOVING)
        rig.steering.on_time(0.0)
        assert rig.steering.on_time(9.9) == []
        assert "no message from the device for 10 s" in logged(rig.steering.on_time(10.0))
        assert state_of(rig) == (SteeringState.STEERING, Awaiting.RESULT)
        assert rig.steering.on_time(1e3) == []
        actions = rig.settle(1) if by_joints else rig.steering.on_device(MOVING)
        assert "sends messages again" in logged(actions)
        assert not rig.steering.watchdog.silence
    # A stop ends the silence, too.
    rig.steering.on_time(2e3)
    rig.steering.on_time(2.01e3)
    assert rig.steering.watchdog.silence
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
    assert "retracted: withdraw it first" in rig.start()
    # The retraction is logged once.
    assert rig.withdraw() == []
    assert rig.start() == "steering"
    assert sent(rig.expose()).insertion == pytest.approx(0.001)


def test_a_device_that_stops_ends_steering() -> None:
    for status, state in (
        (device("FAULT", reason="following error"), FAULT),
        (device("ESTOPPED", reason="pressed"), FAULT),
        (device("DISABLED"), IDLE),
        (device("UNCONFIGURED", False), IDLE),
    ):
        rig = Rig()
        step = sent(rig.expose())
        text = logged(rig.steering.on_device(status))
        assert f"{state.value}: device is {status.state}" in text
        assert status.reason in text
        assert state_of(rig) == (state, NOTHING)
        assert rig.steering.on_result(step.stamp_ns, "aborted: stopped") == rig.expose() == []
        rig.steering.on_device(HOLD)
        assert rig.start() == "steering"


def test_commands_without_motion_are_a_fault_unless_something_resets_their_count() -> None:
    def abort(count: int) -> str:
        actions: list[Action] = []
        for _ in range(count):
            assert rig.steering.state is SteeringState.STEERING
            actions = rig.steering.on_result(sent(rig.expose()).stamp_ns, "aborted: no")
        return logged(actions)

    rig = Rig()
    # A little motion, a release of the hold, and a start after the fault reset the count.
    abort(MAX_ABORTS_AT_REST - 1)
    rig.run(sent(rig.expose()), part=0.01, text="aborted: slow")
    abort(MAX_ABORTS_AT_REST - 1)
    rig.steering.on_device(FREE)
    rig.steering.on_device(HOLD)
    for _ in range(2):
        text = abort(MAX_ABORTS_AT_REST)
        assert "10 commands in a row ended without motion; last result: aborted: no" in text
        assert state_of(rig) == (FAULT, NOTHING)
        assert rig.start() == "steering"


@pytest.mark.parametrize("share", [0.0, 0.9])
def test_unfollowed_steps_in_a_row_are_a_fault(share: float) -> None:
    rig = Rig()
    rig.steps(3)
    # Both followed steps and a start after the fault reset the count.
    for _ in range(2):
        rig.run(rig.good_tips(), part=share)
        assert "device/result reports success" in logged(rig.settle())
        assert "device/result reports success" in rig.steering.reason
        rig.run(rig.good_tips())
        for count in range(1, MAX_UNFOLLOWED_STEPS + 1):
            assert rig.steering.state is SteeringState.STEERING
            rig.run(rig.good_tips(), part=share)
            assert ("3 times in a row" in logged(rig.settle())) is (count == MAX_UNFOLLOWED_STEPS)
        assert state_of(rig) == (FAULT, NOTHING)
        assert rig.start() == "steering"
    assert rig.steering.step == 5
