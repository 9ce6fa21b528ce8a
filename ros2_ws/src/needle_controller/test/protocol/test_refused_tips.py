"""Tips that are refused, and the wait for a good one."""

from __future__ import annotations

import numpy as np
import pytest

from needle_controller.protocol.steering_types import Awaiting, SteeringState
from needle_controller.protocol.tip_gate import Fault, TipMeasurement
from needle_core.component import Log

from .rig import HELD, MOVING, TICK, Rig, logged, none_sent, sent, where


@pytest.mark.parametrize(
    ("position", "frame", "said"),
    [
        ([np.nan, 0.0, 0.0], "rig", "not finite"),
        ([0.0, 0.0, 0.0], "left_camera_optical", "left_camera_optical"),
        ([0.5, 0.2, 1.0], "rig", "from the entry point"),
        # Too large to be squared.
        ([-1e300, 0.2, 1.0], "rig", "from the entry point"),
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
    assert rig.steering.intake.refused.total() == 1
    assert said in rig.steering.reason
    assert rig.steering.control.started == before
    assert where(rig) == (SteeringState.STEERING, Awaiting.TIP)
    assert rig.steering.intake.after_ns == bad.stamp_ns
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
    assert where(rig) == (SteeringState.STEERING, Awaiting.RESULT)
    bad = TipMeasurement(rig.now + TICK // 2, "rig", np.array([0.1, 0.0, 1.0]))
    assert "from the entry point" in logged(rig.steering.on_tip(bad))
    assert rig.steering.intake.refused.total() == 1
    good = TipMeasurement(rig.now + TICK // 2, "rig", np.array([0.0, 0.0, 1e-3]))
    assert rig.steering.on_tip(good) == []
    rig.run(step)
    sent(rig.expose())


def test_an_old_stamp_is_refused_and_does_not_set_the_clock_back() -> None:
    rig = Rig()
    rig.run(sent(rig.expose()))
    after = rig.steering.intake.after_ns
    old = TipMeasurement(TICK, "rig", np.zeros(3))
    assert "not newer" in logged(rig.steering.on_tip(old))
    assert rig.steering.intake.after_ns == after
    sent(rig.expose())


def test_a_stamp_far_ahead_is_refused_and_does_not_block() -> None:
    rig = Rig()
    future = TipMeasurement(rig.now + 3600 * 10**9, "rig", np.zeros(3))
    assert "ahead of joint_states" in logged(rig.steering.on_tip(future))
    assert rig.steering.intake.after_ns < future.stamp_ns
    sent(rig.expose())


def test_a_tip_older_than_the_joints_kept_is_refused() -> None:
    rig = Rig()
    rig.steering.intake.after_ns = 0
    assert "older" in logged(rig.steering.on_tip(TipMeasurement(1, "rig", np.zeros(3))))


def test_no_tip_in_time_waits_and_a_good_one_goes_on() -> None:
    rig = Rig()
    timeout = rig.steering.settings.tip_timeout
    assert rig.steering.on_time(100.0) == []
    assert rig.steering.on_time(100.0 + 0.99 * timeout) == []
    assert where(rig) == (SteeringState.STEERING, Awaiting.TIP)
    assert "no good tip" in logged(rig.steering.on_time(100.0 + timeout))
    assert where(rig) == (SteeringState.WAITING_FOR_TIP, Awaiting.TIP)
    assert rig.steering.watchdog_trips == 1
    assert rig.steering.on_time(100.0 + 3 * timeout) == []
    bad = TipMeasurement(rig.now + TICK, "rig", np.full(3, np.nan))
    rig.expose(bad)
    assert where(rig) == (SteeringState.WAITING_FOR_TIP, Awaiting.TIP)
    sent(rig.expose())
    assert where(rig) == (SteeringState.STEERING, Awaiting.RESULT)


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
    assert rig.steering.state is SteeringState.STEERING


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


def test_each_reason_to_refuse_a_tip_is_told_for_itself() -> None:
    rig = Rig()
    kinds = set()
    for position, frame in ((np.full(3, np.nan), "rig"), (np.zeros(3), "map"), (np.ones(3), "rig")):
        (log,) = rig.expose(TipMeasurement(rig.now + TICK, frame, position))
        assert isinstance(log, Log)
        kinds.add(log.kind)
    assert len(kinds) == 3
    assert rig.steering.intake.refused.total() == 3
