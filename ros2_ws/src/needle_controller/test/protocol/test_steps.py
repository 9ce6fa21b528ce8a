"""One step after the other."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from needle_controller.observers.luenberger import LuenbergerObserver
from needle_controller.presets.own_estimator import OwnEstimator
from needle_controller.presets.own_parts import OwnPart
from needle_controller.presets.presets import observer_settings
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.steering_types import Awaiting, PublishUpdate, SteeringState
from needle_controller.protocol.tip_gate import TipMeasurement

from .rig import FREE, HELD, MOVING, TICK, Rig, logged, none_sent, sent, where


def test_start_without_hold_asks_for_no_tip_until_somebody_holds() -> None:
    rig = Rig(held=False)
    assert where(rig) == (SteeringState.STEERING, Awaiting.HOLD)
    assert none_sent(rig.expose())
    assert rig.steering.on_device(HELD) == []
    assert where(rig) == (SteeringState.STEERING, Awaiting.TIP)
    # The tip seen before the hold is not used, a new one is asked for.
    assert rig.steering.intake.after_ns == rig.now
    sent(rig.expose())


def test_a_tip_leads_to_one_step() -> None:
    rig = Rig()
    assert where(rig) == (SteeringState.STEERING, Awaiting.TIP)
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
    assert where(rig) == (SteeringState.STEERING, Awaiting.RESULT)
    # One tip, one step.
    assert none_sent(rig.expose())


def test_a_finished_step_asks_for_a_tip_exposed_after_its_end() -> None:
    rig = Rig()
    step = sent(rig.expose())
    assert none_sent(rig.run(step))
    end = rig.now
    assert where(rig) == (SteeringState.STEERING, Awaiting.TIP)
    assert rig.steering.step == 1
    assert rig.steering.intake.after_ns == end
    early = TipMeasurement(end - TICK // 2, "rig", np.array([0.0, 0.0, 0.0009]))
    assert rig.steering.on_tip(early) == []
    assert rig.steering.intake.refused.total() == 0
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
    assert where(rig) == (SteeringState.STEERING, Awaiting.TIP)
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
    assert where(rig) == (SteeringState.STEERING, Awaiting.DEVICE)
    sent(rig.steering.on_device(HELD))
    assert where(rig) == (SteeringState.STEERING, Awaiting.RESULT)


def test_a_hold_lost_before_the_step_asks_for_a_fresh_tip() -> None:
    rig = Rig()
    rig.steering.on_device(MOVING)
    rig.expose()
    assert none_sent(rig.steering.on_device(FREE))
    assert where(rig) == (SteeringState.STEERING, Awaiting.HOLD)
    assert none_sent(rig.steering.on_device(HELD))
    assert where(rig) == (SteeringState.STEERING, Awaiting.TIP)
    assert rig.steering.intake.after_ns == rig.now
    sent(rig.expose())


def test_an_aborted_step_resumes_from_where_the_joints_are() -> None:
    rig = Rig()
    step = sent(rig.expose())
    rig.steering.on_device(FREE)
    rig.run(step, part=0.3, text="aborted: hold released")
    assert where(rig) == (SteeringState.STEERING, Awaiting.HOLD)
    assert rig.steering.step == 0
    assert "hold released" in rig.steering.reason
    assert none_sent(rig.expose())
    rig.steering.on_device(HELD)
    again = sent(rig.expose())
    assert again.insertion == pytest.approx(0.0003 + 0.001)


def test_joints_that_are_heard_late_do_not_show_a_standstill() -> None:
    rig = Rig()
    step = sent(rig.expose())
    answered = 10**18
    for _ in range(10):
        rig.now += TICK
        rig.steering.on_joints(JointSample(rig.now, 0.0, 0.0, sent_ns=answered - 1))
    rig.steering.on_result(step.stamp_ns, "succeeded", answered)
    for _ in range(10):
        rig.now += TICK
        sample = JointSample(rig.now, 0.0, 0.0, sent_ns=answered - 1)
        assert rig.steering.on_joints(sample) == []
    assert none_sent(rig.steering.on_tip(rig.measured()))
    for share in (0.5, 1.0):
        rig.now += TICK
        place = share * step.insertion, share * step.rotation
        rig.steering.on_joints(JointSample(rig.now, *place, sent_ns=answered))
    assert rig.steering.step == 1
    assert rig.steering.intake.after_ns == rig.now


def test_answers_to_other_commands_are_not_ours() -> None:
    rig = Rig()
    step = sent(rig.expose())
    assert rig.steering.on_result(step.stamp_ns - 1, "succeeded") == []
    assert where(rig) == (SteeringState.STEERING, Awaiting.RESULT)


def test_the_last_step_ends_at_the_depth_and_then_it_is_done() -> None:
    rig = Rig(depth=0.0025)
    ends = []
    while rig.steering.state is SteeringState.STEERING:
        actions = rig.expose()
        if rig.steering.state is SteeringState.STEERING:
            step = sent(actions)
            ends.append((step.insertion, step.duration))
            rig.run(step)
    np.testing.assert_allclose(ends, [(0.001, 0.5), (0.002, 0.5), (0.0025, 0.25)])
    assert ends[-1][0] == 0.0025
    assert where(rig) == (SteeringState.DONE, Awaiting.NOTHING)
    assert rig.steering.insertion == 0.0025
    assert not rig.steering.on_start()[0].success


def test_an_own_estimator_that_fails_on_the_way_stops_the_needle() -> None:
    class Broken(LuenbergerObserver):
        is_mended = False

        def __init__(self, settings: SteeringSettings, *_: object) -> None:
            super().__init__(observer_settings(settings, settings.gains()))

        def advance(self, d_insertion: npt.ArrayLike, d_rotation: npt.ArrayLike) -> None:
            if not self.is_mended:
                raise RuntimeError("no")

    rig = Rig()
    settings, rng = rig.steering.settings, np.random.default_rng(0)
    part = OwnPart("estimator", "broken", "package 1.0, module:Broken", Broken)
    own = OwnEstimator(part, settings, np.eye(3), np.zeros(3), rng)
    rig.steering.control._estimator = own
    rig.run(sent(rig.expose()))
    actions = rig.expose()
    assert none_sent(actions)
    assert where(rig) == (SteeringState.FAULT, Awaiting.NOTHING)
    assert "estimator 'broken' (package 1.0, module:Broken): advance(" in logged(actions)
    assert "raised RuntimeError: no at test_steps.py:" in rig.steering.reason
    # A tip that comes later moves nothing either.
    Broken.is_mended = True
    assert none_sent(rig.expose())
    assert rig.steering.on_start()[0].success
    assert not none_sent(rig.expose())
