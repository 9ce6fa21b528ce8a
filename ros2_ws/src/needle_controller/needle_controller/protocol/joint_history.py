"""Recent joint positions, checked for plausibility and interpolated between samples."""

from __future__ import annotations

import dataclasses
import enum
import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterator

from needle_core.errors import UserError
from needle_core.messages import INSERTION_JOINT, ROTATION_JOINT, JointState

CONFIRMED_BY = 5
"""Consecutive samples, consistent with one another, that replace the history after a jump."""
LARGEST_GAP_NS = 1_000_000_000
"""Longest time between two consistent samples [ns]."""
_MAX_INSERTION_SPEED, _MAX_ROTATION_SPEED = 0.05, 30.0
"""Speeds of a needle pushed by hand [m/s], and of a motor [rad/s]."""
_INSERTION_NOISE, _ROTATION_NOISE = 2e-4, 0.1  # [m], [rad]
_REST_INSERTION = 2e-6
"""Largest change of the insertion at rest [m]."""
_LONGEST_MOTION = 0.04
"""Longest duration of a motion between two samples [s]."""


@dataclasses.dataclass(frozen=True)
class JointSample:
    """Joint positions of the needle's base at one instant.

    Attributes
    ----------
    stamp_ns : int
        Time of sampling [ns].
    insertion : float
        Insertion of the base [m].
    rotation : float
        Rotation of the base [rad], not wrapped.
    sent_ns : int
        Time at which the device sent the sample, on its own clock [ns]; 0 if unknown.
    """

    stamp_ns: int
    insertion: float
    rotation: float
    sent_ns: int = 0

    def is_near(self, other: JointSample, insertion: float, rotation: float) -> bool:
        """Return True if both joints are within tolerances [m], [rad] of another sample."""
        return (
            abs(self.insertion - other.insertion) <= insertion
            and abs(self.rotation - other.rotation) <= rotation
        )

    def is_at_rest(self, other: JointSample, rotation: float = math.inf) -> bool:
        """Return True if the insertion is that of another sample, and the rotation nearly so."""
        return self.is_near(other, _REST_INSERTION, rotation)


def joint_sample(message: JointState, sent_ns: int) -> JointSample:
    """Return the joint positions of a message that was sent at `sent_ns`.

    Raises
    ------
    UserError
        A joint is missing or not finite.
    """
    position = dict(zip(message.names, message.positions, strict=False))
    missing = [name for name in (INSERTION_JOINT, ROTATION_JOINT) if name not in position]
    if missing:
        raise UserError(f"joint_states without {' and '.join(missing)}: {list(message.names)}")
    insertion, rotation = position[INSERTION_JOINT], position[ROTATION_JOINT]
    if not (math.isfinite(insertion) and math.isfinite(rotation)):
        raise UserError(f"joint_states are not finite: {insertion} m, {rotation} rad")
    return JointSample(message.stamp_ns, insertion, rotation, sent_ns)


class SampleResult(enum.Enum):
    """Result of adding a sample."""

    ACCEPTED = "accepted"
    REPEATED = "repeated"
    REJECTED = "rejected"
    JUMPED = "jumped"


class JointHistory:
    """Joint samples of the last seconds.

    A sample is accepted if it is newer than the last one by at most a second and no farther away
    than the joints can move in that time. Other samples are held back, which drops single spikes;
    once `CONFIRMED_BY` of them are consistent with one another, the history restarts with them.

    Parameters
    ----------
    length : int
        Number of samples kept; 1000 samples are 20 s at 50 Hz.

    Attributes
    ----------
    rejected : int
        Number of samples that were inconsistent with the previous one.
    problem : str
        Why the last sample is held back; empty if it was accepted.
    """

    def __init__(self, length: int = 1000) -> None:
        self._length = length
        self._samples: list[JointSample] = []
        self._held_back: list[JointSample] = []
        self.rejected = 0
        self.problem = ""

    @property
    def latest(self) -> JointSample | None:
        """Newest sample; None before the first."""
        return self._samples[-1] if self._samples else None

    @property
    def oldest(self) -> JointSample | None:
        """Oldest sample kept; None before the first."""
        return self._samples[0] if self._samples else None

    def add(self, sample: JointSample) -> SampleResult:
        """Add a sample if it is consistent with the last one."""
        latest = self.latest
        if latest is None:
            self._samples.append(sample)
            return SampleResult.ACCEPTED
        if 0 <= latest.stamp_ns - sample.stamp_ns <= LARGEST_GAP_NS:
            return SampleResult.REPEATED
        if not _is_consistent(latest, sample):
            return self._hold_back(latest, sample)
        self._held_back.clear()
        self.problem = ""
        self._samples.append(sample)
        # Delete in bulk: deleting the first element of a list shifts all the others.
        if len(self._samples) >= 2 * self._length:
            del self._samples[: self._length]
        return SampleResult.ACCEPTED

    def at(self, stamp_ns: int) -> JointSample | None:
        """Return the joint positions at an instant [ns], interpolated linearly.

        Return None unless samples bracket the instant.
        """
        samples = self._samples
        if not samples or not samples[0].stamp_ns <= stamp_ns <= samples[-1].stamp_ns:
            return None
        after = bisect_left(samples, stamp_ns, key=lambda sample: sample.stamp_ns)
        right = samples[after]
        if right.stamp_ns == stamp_ns:
            return right
        left = samples[after - 1]
        share = (stamp_ns - left.stamp_ns) / (right.stamp_ns - left.stamp_ns)
        return JointSample(
            stamp_ns,
            left.insertion + share * (right.insertion - left.insertion),
            left.rotation + share * (right.rotation - left.rotation),
        )

    def between(self, start: JointSample, end: JointSample, spacing: float) -> list[JointSample]:
        """Return the samples between two others whose insertions are at least `spacing` [m] apart.

        Parameters
        ----------
        start, end : JointSample
            Ends of the motion; they are not returned.
        spacing : float
            Least insertion from one sample to the next, and to both ends [m].
        """
        kept, last = [], start.insertion
        for sample in self.after(start.stamp_ns):
            if sample.stamp_ns >= end.stamp_ns:
                break
            if last + spacing <= sample.insertion <= end.insertion - spacing:
                kept.append(sample)
                last = sample.insertion
        return kept

    def after(self, stamp_ns: int) -> Iterator[JointSample]:
        """Yield the samples newer than an instant [ns], oldest first."""
        first = bisect_right(self._samples, stamp_ns, key=lambda sample: sample.stamp_ns)
        yield from self._samples[first:]

    def _hold_back(self, latest: JointSample, sample: JointSample) -> SampleResult:
        self.rejected += 1
        held_back = self._held_back
        if held_back and not _is_consistent(held_back[-1], sample):
            held_back.clear()
        held_back.append(sample)
        if len(held_back) >= CONFIRMED_BY:
            self._samples, self._held_back = held_back, []
            self.problem = ""
            return SampleResult.JUMPED
        self.problem = (
            f"joint_states are inconsistent with the last: {sample.insertion:.4g} m, "
            f"{sample.rotation:.4g} rad after {latest.insertion:.4g} m, {latest.rotation:.4g} rad, "
            f"{(sample.stamp_ns - latest.stamp_ns) * 1e-9:.4g} s later"
        )
        return SampleResult.REJECTED


def _is_consistent(before: JointSample, sample: JointSample) -> bool:
    gap_ns = sample.stamp_ns - before.stamp_ns
    if not 0 < gap_ns <= LARGEST_GAP_NS:
        return False
    time = min(gap_ns * 1e-9, _LONGEST_MOTION)
    return sample.is_near(
        before,
        _MAX_INSERTION_SPEED * time + _INSERTION_NOISE,
        _MAX_ROTATION_SPEED * time + _ROTATION_NOISE,
    )
