"""Monitors of the needle's motion: steps, failed commands, retraction and missing inputs."""

from __future__ import annotations

import enum
import math
import statistics
from collections import deque

from needle_controller.protocol.actions import Action, SendStep
from needle_controller.protocol.joint_history import JointHistory, JointSample
from needle_core.component import Log

_REST_ROTATION = 1e-4
"""Largest change of the rotation at rest [rad]."""
MAX_ABORTS_AT_REST = 10
"""Consecutive commands without motion after which the controller gives up."""
MAX_UNFOLLOWED_STEPS = 3
"""Consecutive steps, reported as succeeded but not executed, after which it gives up."""
_ARRIVED_INSERTION, _ARRIVED_ROTATION = 1e-5, 1e-2
"""Distance of both joints from the step's end at which it counts as reached [m], [rad]."""
_STANDSTILL_SAMPLES = 5
"""Samples at one position, sent after the device's answer, that show a standstill."""
_MEDIAN_OF = 5
"""Samples whose median is the needle's insertion, so that two spikes do not count as motion."""
_FEWEST_SAMPLES = 3
_SAME_ROTATION = 0.1
"""Rotation within which the joints are back where they were before a jump [rad]."""


class StepOutcome(enum.Enum):
    """Outcome of a step according to the joints."""

    PENDING = "pending"
    ARRIVED = "arrived"
    STOPPED_SHORT = "stopped short"


class StepMonitor:
    """Checks from the joints' stamps whether a step that the device reports as done was executed.

    Joints that were sent before the answer do not show a standstill, however late they arrive:
    they may have been sampled before the motion.

    Parameters
    ----------
    step : SendStep
        The command.
    answered_ns : int
        Time at which the device sent its answer, on its own clock [ns].

    Attributes
    ----------
    step : SendStep
        The command.
    end_ns : int
        Stamp of the deciding sample: the first at the step's end, or the last at a standstill
        elsewhere [ns].
    """

    def __init__(self, step: SendStep, answered_ns: int) -> None:
        self._answered_ns = answered_ns
        self.step = step
        self.end_ns = step.stamp_ns
        self._standing: list[JointSample] = []

    def update(self, joints: JointHistory, sample: JointSample | None) -> StepOutcome:
        """Return the outcome of the step.

        Parameters
        ----------
        joints : JointHistory
            All accepted samples.
        sample : JointSample or None
            The sample received since the last call.
        """
        step = self.step
        for known in joints.after(step.stamp_ns):
            # A position beyond the end counts as arrived: a needle pushed by hand overshoots.
            short = step.insertion - known.insertion
            turn = abs(step.rotation - known.rotation)
            if short <= _ARRIVED_INSERTION and turn <= _ARRIVED_ROTATION:
                self.end_ns = known.stamp_ns
                return StepOutcome.ARRIVED
        if sample is None or sample.sent_ns < self._answered_ns:
            return StepOutcome.PENDING
        standing = self._standing
        if standing and not sample.is_at_rest(standing[0], _REST_ROTATION):
            standing.clear()
        standing.append(sample)
        if len(standing) < _STANDSTILL_SAMPLES:
            return StepOutcome.PENDING
        self.end_ns = sample.stamp_ns
        return StepOutcome.STOPPED_SHORT


class FailureCounter:
    """Counts consecutive failed commands, and reports when the controller should give up."""

    def __init__(self) -> None:
        self._aborts = 0
        self._unfollowed = 0

    def reset(self) -> None:
        """Reset both counts, after a completed step or an action of the operator."""
        self._aborts = self._unfollowed = 0

    def count_abort(self, text: str, *, moved: bool) -> str:
        """Count an aborted command; return the reason to give up, empty below the limit."""
        self._aborts = 0 if moved else self._aborts + 1
        if self._aborts < MAX_ABORTS_AT_REST:
            return ""
        return f"{self._aborts} commands in a row ended without motion; last result: {text}"

    def count_unfollowed(self, step: SendStep, at: JointSample) -> tuple[str, bool]:
        """Count a step that the joints did not follow.

        Parameters
        ----------
        step : SendStep
            The command.
        at : JointSample
            Present joint positions.

        Returns
        -------
        text : str
            Description of the failure.
        give_up : bool
            Whether the limit is reached.
        """
        self._unfollowed += 1
        text = (
            f"device/result reports success, but joint_states are at {at.insertion:.6g} m, "
            f"{at.rotation:.4g} rad, not at {step.insertion:.6g} m, {step.rotation:.4g} rad"
        )
        if self._unfollowed < MAX_UNFOLLOWED_STEPS:
            return text, False
        return f"{text}; {self._unfollowed} times in a row: check drives and joint_states", True


class RetractionMonitor:
    """Detects retraction, after which the needle must be withdrawn before it is steered again.

    The model holds for forward insertion only. After a jump of the joints, whose motion was not
    observed, steering may resume once the joints are back where they were.
    """

    def __init__(self) -> None:
        self._retracted = False
        self._deepest = -math.inf
        self._recent: deque[float] = deque(maxlen=_MEDIAN_OF)
        self._jump: tuple[JointSample, JointSample] | None = None

    @property
    def reason(self) -> str:
        """Reason to withdraw the needle before it is steered; empty if there is none."""
        if self._retracted:
            return "the needle was retracted: withdraw it first"
        if self._jump is not None:
            before, after = self._jump
            return (
                f"joint_states jumped from {before.insertion:.4g} m, {before.rotation:.4g} rad to "
                f"{after.insertion:.4g} m, {after.rotation:.4g} rad: withdraw the needle first"
            )
        return ""

    def reset(self, insertion: float) -> None:
        """Start over at an insertion [m]."""
        self._deepest = insertion
        self._retracted = False
        self._recent.clear()
        self._jump = None

    def update(self, insertion: float, *, out_below: float, tolerance: float) -> bool:
        """Add a sample; return whether the needle is being retracted.

        Parameters
        ----------
        insertion : float
            Insertion of the needle [m].
        out_below : float
            Largest insertion at which the needle counts as out [m].
        tolerance : float
            Backward motion that does not count as retraction [m].
        """
        self._recent.append(insertion)
        if len(self._recent) < _FEWEST_SAMPLES:
            return False
        here = statistics.median_low(self._recent)
        is_out = here <= out_below
        if self._jump is not None:
            if is_out:
                self.reset(here)
            return False
        self._deepest = max(self._deepest, here)
        retracting = self._deepest - here > tolerance
        self._retracted = not is_out and (self._retracted or retracting)
        if is_out and retracting:
            self._deepest = here
        return retracting

    def add_jump(self, before: JointSample, after: JointSample, tolerance: float) -> bool:
        """Record a jump of the joints, whose motion was not observed.

        Parameters
        ----------
        before, after : JointSample
            Joint positions before and after the jump.
        tolerance : float
            Difference of insertion within which the joints are back [m].

        Returns
        -------
        bool
            Whether the joints are away from their last observed position.
        """
        self._recent.clear()
        observed = self._jump[0] if self._jump else before
        away = not after.is_near(observed, tolerance, _SAME_ROTATION)
        self._jump = (observed, after) if away else None
        return away


class Watchdog:
    """Measures waiting times on the steady clock; `steady` is its reading [s].

    Attributes
    ----------
    silence : str
        Description of the device's silence; empty while messages arrive.
    """

    def __init__(self) -> None:
        self.silence = ""
        self._since: float | None = None
        self._received_since: float | None = None
        self._last_joints: JointSample | None = None

    def restart(self) -> None:
        """Restart both waiting times."""
        self._since = self._received_since = None

    def on_device_message(self) -> list[Action]:
        """Reset the silence of the device, and log its end."""
        self._received_since = None
        was_silent, self.silence = bool(self.silence), ""
        return [Log("info", "the device sends messages again")] if was_silent else []

    def waited(self, steady: float, *, moving: bool) -> float:
        """Return the waiting time [s], which does not run while the needle moves."""
        if self._since is None or moving:
            self._since = steady
        return steady - self._since

    def check_silence(self, steady: float, timeout: float) -> list[Action]:
        """Log once that no message of the device has arrived for `timeout` [s].

        There is no further reaction: a paused simulation is as silent as a driver that has ended.
        """
        if self._received_since is None:
            self._received_since = steady
        if self.silence or steady - self._received_since < timeout:
            return []
        self.silence = f"no message from the device for {timeout:g} s during a step"
        return [Log("warning", self.silence)]

    def has_moved(self, latest: JointSample | None) -> bool:
        """Return whether the insertion has changed since the last call."""
        before, self._last_joints = self._last_joints, latest
        return not (latest is None or before is None or latest.is_at_rest(before))
