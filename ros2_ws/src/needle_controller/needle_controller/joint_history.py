"""What the joints measured, at any instant between two samples."""

from __future__ import annotations

import dataclasses
import math
from bisect import bisect_left


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
    """

    stamp_ns: int
    insertion: float
    rotation: float


class JointHistory:
    """The joints of the last seconds.

    Parameters
    ----------
    length : int
        Samples kept; 1000 are 20 s at 50 Hz.
    """

    def __init__(self, length: int = 1000) -> None:
        self._length = length
        self._samples: list[JointSample] = []

    @property
    def latest(self) -> JointSample | None:
        """The newest sample, None before the first."""
        return self._samples[-1] if self._samples else None

    @property
    def oldest(self) -> JointSample | None:
        """The oldest sample kept, None before the first."""
        return self._samples[0] if self._samples else None

    def add(self, sample: JointSample) -> bool:
        """Take a sample; return False for one that is not finite or not newer than the last."""
        if not (math.isfinite(sample.insertion) and math.isfinite(sample.rotation)):
            return False
        if self._samples and sample.stamp_ns <= self._samples[-1].stamp_ns:
            return False
        self._samples.append(sample)
        # Dropped in bulk, not at each sample: a list shifts all it holds.
        if len(self._samples) >= 2 * self._length:
            del self._samples[: self._length]
        return True

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

    def motion_end_ns(self, insertion_tolerance: float, rotation_tolerance: float) -> int | None:
        """Return the stamp since which the joints have stood still.

        It depends on the samples alone, not on when the question is asked after the motion.

        Parameters
        ----------
        insertion_tolerance, rotation_tolerance : float
            What still counts as the same place [m], [rad].

        Returns
        -------
        int or None
            Stamp of the first of the last samples that all agree with the newest [ns]; None before
            the first.
        """
        end = None
        latest = self.latest
        for sample in reversed(self._samples):
            if latest is None or (
                abs(sample.insertion - latest.insertion) > insertion_tolerance
                or abs(sample.rotation - latest.rotation) > rotation_tolerance
            ):
                break
            end = sample.stamp_ns
        return end
