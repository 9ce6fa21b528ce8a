"""What the device answers, or does not, and retraction."""

from __future__ import annotations

import numpy as np
import pytest

from needle_controller.protocol.steering_types import Awaiting, SteeringState
from needle_controller.protocol.step_watch import MOST_REFUSALS
from needle_core.status_messages import DeviceStatus

from .rig import FREE, HELD, MOVING, TICK, Rig, device, logged, none_sent, sent, where


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
    assert where(rig) == (SteeringState.FAULT, Awaiting.NOTHING)
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
    assert rig.steering.state is SteeringState.STEERING


def test_a_device_that_falls_silent_within_a_step_is_named_and_heard_again() -> None:
    rig = Rig()
    step = sent(rig.expose())
    rig.steering.on_device(MOVING)
    rig.steering.on_time(0.0)
    said = logged(rig.steering.on_time(rig.steering.settings.result_timeout))
    assert "nothing heard of the device" in said
    assert rig.steering.patience.silence
    assert where(rig) == (SteeringState.STEERING, Awaiting.RESULT)
    assert rig.steering.on_time(1e3) == []
    rig.run(step)
    assert not rig.steering.patience.silence
    rig.steering.on_device(HELD)
    sent(rig.expose())


def test_a_retraction_ends_steering_until_the_needle_is_out() -> None:
    rig = Rig()
    for _ in range(5):
        rig.run(sent(rig.expose()))
    rig.settle()
    rig.insertion -= 0.0001
    assert rig.settle() == []
    rig.now += TICK
    rig.insertion -= 0.0002
    assert "retracted" in logged(rig.settle())
    assert where(rig) == (SteeringState.IDLE, Awaiting.NOTHING)
    assert "retracted" in rig.steering.on_start()[0].message
    rig.insertion = 0.004
    rig.settle()
    assert not rig.steering.on_start()[0].success
    while rig.insertion > 0.0:
        rig.insertion = max(rig.insertion - 0.0005, 0.0)
        rig.settle(1)
    rig.settle()
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
        (device("FAULT", True, "", "following error"), SteeringState.FAULT),
        (device("ESTOPPED", True, "", "pressed"), SteeringState.FAULT),
        (device("DISABLED", True, ""), SteeringState.IDLE),
        (device("UNCONFIGURED", False, ""), SteeringState.IDLE),
    ],
)
def test_a_device_that_stops_ends_steering(device: DeviceStatus, state: SteeringState) -> None:
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
        assert rig.steering.state is SteeringState.STEERING
        step = sent(rig.expose())
        actions = rig.steering.on_result(step.stamp_ns, "aborted: beyond a limit")
    assert where(rig) == (SteeringState.FAULT, Awaiting.NOTHING)
    assert "beyond a limit" in logged(actions)


def test_a_person_who_lets_go_at_once_many_times_is_no_fault() -> None:
    rig = Rig()
    for _ in range(2 * MOST_REFUSALS):
        step = sent(rig.expose())
        rig.steering.on_result(step.stamp_ns, "aborted: hold released")
        rig.steering.on_device(FREE)
        rig.steering.on_device(HELD)
    assert where(rig) == (SteeringState.STEERING, Awaiting.TIP)


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
