"""Whether the joints followed a step, since when they are where it led, and how often not."""

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

MOST_REFUSALS = 10
"""Commands in a row that may end without motion before the controller gives up."""
MOST_UNFOLLOWED = 3
"""Steps in a row that may be said to have succeeded without the joints being where they led."""


class Followed(enum.Enum):
    """State of a step, as the joints show it."""

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


class FailedSteps:
    """Counts steps in a row that came to nothing, and says when that is enough."""

    def __init__(self) -> None:
        self._refusals = 0
        self._unfollowed = 0

    def forget(self) -> None:
        """Start over: a step was done, or a person has looked."""
        self._refusals = self._unfollowed = 0

    def aborted(self, text: str, *, moved: bool) -> str:
        """Take a command that was aborted; return why to give up, empty if it is too early."""
        self._refusals = 0 if moved else self._refusals + 1
        if self._refusals < MOST_REFUSALS:
            return ""
        return f"{self._refusals} commands in a row ended without motion, the last {text}"

    def unfollowed(self, step: SendStep, at: JointSample) -> tuple[str, bool]:
        """Take a step that the joints did not follow; return that in words, and whether to give up.

        Parameters
        ----------
        step : SendStep
            What was sent.
        at : JointSample
            Where the joints stand.
        """
        self._unfollowed += 1
        text = (
            f"a step is said to have succeeded, but joint_states stand at {at.insertion:.6g} m, "
            f"{at.rotation:.4g} rad, not at {step.insertion:.6g} m, {step.rotation:.4g} rad"
        )
        if self._unfollowed < MOST_UNFOLLOWED:
            return text, False
        return f"{text}; so were {self._unfollowed} in a row: see to drives and joint_states", True
