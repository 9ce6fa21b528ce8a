"""Whether the joints followed a step, and since when they are where it led."""

from __future__ import annotations

import enum

from needle_controller.protocol.joint_history import JointHistory, JointSample
from needle_controller.protocol.steering_types import SendStep

ARRIVED_INSERTION, ARRIVED_ROTATION = 1e-5, 1e-2
"""A step has ended when both joints are so close to where it led [m], [rad]."""
REST_INSERTION, REST_ROTATION = 2e-6, 1e-4
"""What a joint at rest may change by [m], [rad]."""
_STANDSTILL = 5
"""Samples at one place, sent after the answer, which say that the joints do not go on."""


class Followed(enum.Enum):
    """What the joints say of a step."""

    NOT_YET = "not yet"
    ARRIVED = "arrived"
    STOOD = "stood"


class StepWatch:
    """Judges a step that is said to have succeeded by the joints' own stamps.

    Joints that were sent before the answer, however late they are heard, do not show a standstill:
    they may be of before the motion.

    Parameters
    ----------
    step : SendStep
        What was sent.
    answered_ns : int
        When the device sent its answer, on its own clock [ns].

    Attributes
    ----------
    step : SendStep
        What was sent.
    end_ns : int
        Stamp of the sample that decided: the first at the step's end, or the last of those that
        stood elsewhere [ns].
    """

    def __init__(self, step: SendStep, answered_ns: int) -> None:
        self._answered_ns = answered_ns
        self.step = step
        self.end_ns = step.stamp_ns
        self._standing: list[JointSample] = []

    def look(self, joints: JointHistory, sample: JointSample | None) -> Followed:
        """Say whether the joints have followed.

        Parameters
        ----------
        joints : JointHistory
            All that is known of them.
        sample : JointSample or None
            What has come since the last look.
        """
        step = self.step
        for known in joints.after(step.stamp_ns):
            # Beyond is arrived, too: a needle pushed by hand does not stop to the micrometre.
            short = step.insertion - known.insertion
            if short <= ARRIVED_INSERTION and abs(step.rotation - known.rotation) <= (
                ARRIVED_ROTATION
            ):
                self.end_ns = known.stamp_ns
                return Followed.ARRIVED
        if sample is None or sample.sent_ns < self._answered_ns:
            return Followed.NOT_YET
        standing = self._standing
        if standing and not sample.is_at(standing[0], REST_INSERTION, REST_ROTATION):
            standing.clear()
        standing.append(sample)
        if len(standing) < _STANDSTILL:
            return Followed.NOT_YET
        self.end_ns = sample.stamp_ns
        return Followed.STOOD
