"""Motion monitors at their bounds."""

from __future__ import annotations

from needle_controller.protocol.actions import SendStep
from needle_controller.protocol.joint_history import JointHistory, JointSample
from needle_controller.protocol.motion_monitors import (
    RetractionMonitor,
    StepMonitor,
    StepOutcome,
)

from .rig import TICK

STEP = SendStep(5 * TICK, 0.01, 0.5, 0.5)
PENDING, ARRIVED, STOPPED_SHORT = StepOutcome
OUT, TOLERANCE = 0.002, 0.0002


def test_a_step_has_arrived_when_both_joints_are_at_or_beyond_its_end() -> None:
    for insertion, rotation, wanted in (
        (0.01 - 0.99e-5, 0.5 + 0.99e-2, ARRIVED),
        (0.0101, 0.5 - 0.99e-2, ARRIVED),
        (0.01 - 1.01e-5, 0.5, PENDING),
        (0.01, 0.5 + 1.01e-2, PENDING),
        (0.01, 0.5 - 1.01e-2, PENDING),
    ):
        watch, joints = StepMonitor(STEP, 0), JointHistory()
        assert watch.end_ns == STEP.stamp_ns
        # A sample with the step's stamp was taken before it; the first at the end decides.
        for stamp, place in ((5, STEP.insertion), (6, insertion), (7, insertion)):
            joints.add(JointSample(stamp * TICK, place, rotation))
        assert watch.update(joints, None) is wanted, insertion
        assert watch.end_ns == (6 if wanted is ARRIVED else 5) * TICK


def outcomes(moved: tuple[float, float], sent: int = 100, answered: int = 100) -> list[StepOutcome]:
    """Return the outcomes for seven samples, of which the third is displaced."""
    watch, verdicts = StepMonitor(STEP, answered), []
    for k in range(7):
        at = moved if k == 2 else (0.0, 0.0)
        sample = JointSample((6 + k) * TICK, 0.005 + at[0], at[1], sent)
        verdicts.append(watch.update(JointHistory(), sample))
        if verdicts[-1] is STOPPED_SHORT:
            assert watch.end_ns == sample.stamp_ns
    return verdicts


def test_five_resting_samples_after_the_answer_are_a_standstill() -> None:
    at_once = [PENDING] * 4 + [STOPPED_SHORT] * 3
    assert outcomes((0.0, 0.0)) == at_once
    assert outcomes((1.9e-6, -0.9e-4)) == at_once
    for moved in ((2.1e-6, 0.0), (0.0, -1.1e-4)):
        # The third sample restarts the count, and so does the fourth.
        assert outcomes(moved) == [PENDING] * 7
    assert outcomes((0.0, 0.0), sent=99) == [PENDING] * 7
    assert StepMonitor(STEP, 0).update(JointHistory(), None) is PENDING


def retractions(watch: RetractionMonitor, *places: float) -> list[bool]:
    return [watch.update(place, out_below=OUT, tolerance=TOLERANCE) for place in places]


def test_retraction_is_detected_from_the_median_of_five_samples() -> None:
    watch = RetractionMonitor()
    assert not any(retractions(watch, *[0.01] * 3, *[0.02] * 5, 0.005, 0.005, *[0.02] * 3))
    assert not any(retractions(watch, *[0.02 - 1.99e-4] * 5))
    assert watch.reason == ""
    assert retractions(watch, *[0.02 - 2.01e-4] * 3)[-1]
    assert "was retracted: withdraw it first" in watch.reason
    # A later insertion does not cancel the retraction; a needle that is out does.
    for place in (0.025, 0.0021):
        retractions(watch, *[place] * 5)
        assert watch.reason
    retractions(watch, *[0.002] * 5)
    assert watch.reason == ""
    # A needle that is out may move back.
    assert retractions(watch, *[0.0015] * 5).count(True) == 1
    assert watch.reason == ""
    # Two samples are too few for a median.
    watch.reset(0.01)
    assert retractions(watch, 0.005, 0.005, 0.005) == [False, False, True]


def test_jumped_joints_are_back_at_their_last_observed_position() -> None:
    for back, away in (
        ((0.0201999, 0.3999), False),
        ((0.0198001, 0.2001), False),
        ((0.020201, 0.3), True),
        ((0.02, 0.401), True),
    ):
        watch, before = RetractionMonitor(), JointSample(0, 0.02, 0.3)
        retractions(watch, *[0.02] * 5)
        assert watch.add_jump(before, JointSample(1, 0.01, 0.3), TOLERANCE)
        assert "jumped from 0.02 m, 0.3 rad to 0.01 m, 0.3 rad: withdraw" in watch.reason
        # Samples after the jump are not a retraction.
        assert not any(retractions(watch, *[0.01] * 5, *[0.005] * 5))
        assert watch.add_jump(JointSample(2, 0.005, 0.3), JointSample(3, *back), TOLERANCE) is away
        assert bool(watch.reason) is away, back
        retractions(watch, *[0.002] * 5)
        assert watch.reason == ""
