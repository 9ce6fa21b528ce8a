"""The tracker over path-traced insertions: metal needles under lamps, over floors of all kinds."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from campaign.tracking.traced_set import DrawnSequence, TracedScene
from campaign.tracking.variations import AS_TRACED, Variation
from needle_tracker.answers.tracker_parameters import default_settings
from needle_tracker.filter.needle_tracker import NeedleTracker
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.stereo.triangulation import SpatialTip

SETTLED = 3
"""Pairs of a sequence's begin that do not count: a tracker without the insertion wants to see a
needle three times."""


class Told(enum.Enum):
    """The tracker's knowledge beside the pairs of a sequence."""

    NOTHING = "without"
    INSERTION = "with"
    EMPTY_PHANTOM = "with the empty phantom and the"  # as on a rig, where a run begins outside


@dataclasses.dataclass(frozen=True, eq=False)
class TracedAnswer:
    """The tracker's answer to a path-traced pair.

    Attributes
    ----------
    scene : TracedScene
        What it showed.
    told : Told
        What the tracker was told.
    tip : SpatialTip or None
        What it believed.
    truth : ndarray, shape (3,), or None
        The end of the shaft's axis in `rig` [m]; None where there is no needle.
    """

    scene: TracedScene
    told: Told
    tip: SpatialTip | None
    truth: NDArray[np.float64] | None

    @property
    def error(self) -> float:
        """Distance of the tip from the truth [m]."""
        return float(np.linalg.norm(self._off))

    @property
    def normalised(self) -> float:
        """Squared error over its covariance."""
        assert self.tip is not None
        return float(self._off @ np.linalg.solve(self.tip.covariance, self._off))

    @property
    def _off(self) -> NDArray[np.float64]:
        assert self.tip is not None
        assert self.truth is not None
        return np.asarray(self.tip.position - self.truth)


def traced_looks(
    sequence: DrawnSequence, told: Told, variation: Variation = AS_TRACED
) -> Iterator[TracedAnswer]:
    """Yield what is said of a sequence's pairs.

    Of a needle the first `SETTLED` pairs are shown and not yielded, nor are pairs that have not all
    of its last 10 mm in both images.

    Parameters
    ----------
    sequence : DrawnSequence
        The pairs.
    told : Told
        What the tracker is told.
    variation : Variation
        What is otherwise than the tracker expects.
    """
    rng = np.random.default_rng(sequence.scene.seed)
    stereo = load_calibration(sequence.calibration)
    left, right = (variation.seen(image, rng) for image in sequence.empty)
    tracker = NeedleTracker(
        stereo,
        dataclasses.replace(
            default_settings(stereo),
            needle_width=variation.width * sequence.scene.look.diameter,
            reference=(left, right) if told is Told.EMPTY_PHANTOM else None,
        ),
    )
    for number, pair in enumerate(sequence.pairs):
        left, right = (variation.seen(image, rng) for image in pair)
        insertion = float(sequence.insertions[number]) + variation.zero
        tip = tracker.process(left, right, None if told is Told.NOTHING else insertion).tip
        if not sequence.scene.look.needle:
            yield TracedAnswer(sequence.scene, told, tip, None)
        elif number >= SETTLED and sequence.seen[number].min() >= 1.0:
            yield TracedAnswer(sequence.scene, told, tip, sequence.tips[number])
