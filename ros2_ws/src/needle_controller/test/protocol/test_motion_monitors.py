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
PENDING, ARRIVED, _ = StepOutcome
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
