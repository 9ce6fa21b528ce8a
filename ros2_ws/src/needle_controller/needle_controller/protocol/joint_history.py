"""Joint positions at any instant between two samples."""

from __future__ import annotations

import dataclasses
import enum
import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterator

CONFIRMED_BY = 5
"""Samples that follow from one another and not from what is kept; so many are the new truth."""
LARGEST_GAP_NS = 1_000_000_000
"""Longest time between two samples of which one follows from the other [ns]."""
_FASTEST_INSERTION, _FASTEST_ROTATION = 0.05, 30.0  # [m/s], [rad/s]: a hand's, a motor's.
_INSERTION_NOISE, _ROTATION_NOISE = 2e-4, 0.1  # [m], [rad]
_LONGEST_MOTION = 0.04
"""Joints are believed to have moved unseen for no longer [s]."""


@dataclasses.dataclass(frozen=True)
class JointSample:
    """The base's joints at one instant.

    Attributes
    ----------
    stamp_ns : int
        Time of sampling [ns].
    insertion : float
        Insertion of the base [m].
    rotation : float
        Rotation of the base [rad], not wrapped.
    sent_ns : int
        When the device sent it, on its own clock [ns]; 0 where nobody knows.
    """

    stamp_ns: int
    insertion: float
    rotation: float
    sent_ns: int = 0

    def is_at(self, other: JointSample, insertion: float, rotation: float) -> bool:
        """Return whether the joints are within tolerances [m], [rad] of where they were."""
        return (
            abs(self.insertion - other.insertion) <= insertion
            and abs(self.rotation - other.rotation) <= rotation
        )


class Heard(enum.Enum):
    """Verdict on a sample."""

    TAKEN = "taken"
    REPEATED = "repeated"
    DOUBTED = "doubted"
    JUMPED = "jumped"


class JointHistory:
    """The joints of the last seconds.

    A sample counts if it follows from the one before: newer by at most a second, and no farther
    than joints move meanwhile. Any other is kept back. A single spike is dropped so; where
    `CONFIRMED_BY` of them follow from one another, the history starts again with them.

    Parameters
    ----------
    length : int
        Samples kept; 1000 are 20 s at 50 Hz.

    Attributes
    ----------
    doubted : int
        Samples that did not follow from the one before.
    complaint : str
        Why the last sample is kept back; empty where it is not.
    """

    def __init__(self, length: int = 1000) -> None:
        self._length = length
        self._samples: list[JointSample] = []
        self._kept_back: list[JointSample] = []
        self.doubted = 0
        self.complaint = ""

    @property
    def latest(self) -> JointSample | None:
        """The newest sample, None before the first."""
        return self._samples[-1] if self._samples else None

    @property
    def oldest(self) -> JointSample | None:
        """The oldest sample kept, None before the first."""
        return self._samples[0] if self._samples else None

    def add(self, sample: JointSample) -> Heard:
        """Take a sample, or say what became of it."""
        latest = self.latest
        finite = math.isfinite(sample.insertion) and math.isfinite(sample.rotation)
        if latest is None or not finite:
            if finite:
                self._samples.append(sample)
            return Heard.TAKEN if finite else Heard.DOUBTED
        if 0 <= latest.stamp_ns - sample.stamp_ns <= LARGEST_GAP_NS:
            return Heard.REPEATED
        if not _follows(latest, sample):
            return self._doubt(latest, sample)
        self._kept_back.clear()
        self.complaint = ""
        self._samples.append(sample)
        # Dropped in bulk, not at each sample: a list shifts all it holds.
        if len(self._samples) >= 2 * self._length:
            del self._samples[: self._length]
        return Heard.TAKEN

    def at(self, stamp_ns: int) -> JointSample | None:
        """Return the joints at an instant, linear between samples.

        Parameters
        ----------
        stamp_ns : int
            The instant [ns].

        Returns
        -------
        JointSample or None
            None until samples at or before and at or after the instant have come.
        """
        samples = self._samples
        if not samples or not samples[0].stamp_ns <= stamp_ns <= samples[-1].stamp_ns:
            return None
        after = bisect_left(samples, stamp_ns, key=lambda sample: sample.stamp_ns)
        right = samples[after]
        if right.stamp_ns == stamp_ns:
            return right
        left = samples[after - 1]
        part = (stamp_ns - left.stamp_ns) / (right.stamp_ns - left.stamp_ns)
        return JointSample(
            stamp_ns,
            left.insertion + part * (right.insertion - left.insertion),
            left.rotation + part * (right.rotation - left.rotation),
        )

    def between(self, start: JointSample, end: JointSample, spacing: float) -> list[JointSample]:
        """Return samples on the way from one to another, whose insertions are spaced out.

        Parameters
        ----------
        start, end : JointSample
            Where the way begins and ends.
        spacing : float
            Least insertion from one to the next, and to the end [m].
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

    def _doubt(self, latest: JointSample, sample: JointSample) -> Heard:
        self.doubted += 1
        kept_back = self._kept_back
        if kept_back and not _follows(kept_back[-1], sample):
            kept_back.clear()
        kept_back.append(sample)
        if len(kept_back) >= CONFIRMED_BY:
            self._samples, self._kept_back = kept_back, []
            self.complaint = ""
            return Heard.JUMPED
        self.complaint = (
            f"joint_states do not follow from the last: {sample.insertion:.4g} m, "
            f"{sample.rotation:.4g} rad after {latest.insertion:.4g} m, {latest.rotation:.4g} rad, "
            f"{(sample.stamp_ns - latest.stamp_ns) * 1e-9:.4g} s later"
        )
        return Heard.DOUBTED


def _follows(before: JointSample, sample: JointSample) -> bool:
    gap_ns = sample.stamp_ns - before.stamp_ns
    if not 0 < gap_ns <= LARGEST_GAP_NS:
        return False
    time = min(gap_ns * 1e-9, _LONGEST_MOTION)
    return sample.is_at(
        before,
        _FASTEST_INSERTION * time + _INSERTION_NOISE,
        _FASTEST_ROTATION * time + _ROTATION_NOISE,
    )
