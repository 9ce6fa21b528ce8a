"""Steps in a row that came to nothing, and when that is enough."""

from __future__ import annotations

from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.steering_types import SendStep

MOST_REFUSALS = 10
"""Commands in a row that may end without motion before the controller gives up."""
MOST_UNFOLLOWED = 3
"""Steps in a row that may be said to have succeeded without the joints being where they led."""


class FailedSteps:
    """Counts them."""

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
