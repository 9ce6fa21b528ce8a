"""The tracker over path-traced insertions: metal needles under lamps, over floors of all kinds."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.path_traced.appearance import Appearance, draw_appearance
from needle_sim.path_traced.insertion import TracedPair, trace_insertion
from needle_sim.path_traced.tracer import load_mitsuba
from needle_tracker.answers.tracker_parameters import default_settings
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.tracking.tip_tracker import TipTracker
from needle_tracker.tracking.triangulation import SpatialTip

PAIRS, SETTLED = 6, 3
"""Pairs of a sequence, and those of its begin that do not count: a tracker without the insertion
wants to see a needle three times."""
_STEP = 1e-3
_BEGIN = (0.02, 0.085)  # insertion of the first pair [m]
_STREAM = 23


class Told(enum.Enum):
    """What the tracker knows beside the pairs of a sequence."""

    NOTHING = "without"
    INSERTION = "with"
    EMPTY_PHANTOM = "with the empty phantom and the"  # as on a rig, where a run begins outside


@dataclasses.dataclass(frozen=True, eq=False)
class TracedAnswer:
    """What the tracker said of a path-traced pair.

    Attributes
    ----------
    scene : Appearance
        How it looked.
    told : Told
        What the tracker was told.
    tip : SpatialTip or None
        What it believed.
    truth : ndarray, shape (3,), or None
        The end of the shaft's axis in `rig` [m]; None where there is no needle.
    """

    scene: Appearance
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
    calibration: Path, appearance: str, seeds: Sequence[int]
) -> Iterator[TracedAnswer]:
    """Trace a sequence for each seed; yield what is said of its pairs, whatever is told.

    Of a needle the first `SETTLED` pairs are shown and not yielded.

    Parameters
    ----------
    calibration : Path
        The rig's.
    appearance : str
        As `draw_appearance` takes it.
    seeds : sequence of int
        Each keys a scene, its path and its noise.

    Raises
    ------
    UserError
        If the path tracer is not installed.
    """
    mitsuba, rig = load_mitsuba(), load_stereo_rig(calibration)
    for seed in seeds:
        scene = draw_appearance(appearance, seed)
        begin = float(np.random.default_rng([seed, _STREAM]).uniform(*_BEGIN))
        depth = begin + (PAIRS - 1) * _STEP
        traced = trace_insertion(mitsuba, rig, scene, frames=PAIRS, depth=depth, begin=begin)
        nothing = dataclasses.replace(scene, needle=False)
        empty = trace_insertion(mitsuba, rig, nothing, frames=1, depth=depth, begin=begin)
        yield from _tracked(calibration, scene, next(empty).images, list(traced))


def _tracked(
    calibration: Path,
    scene: Appearance,
    empty: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    pairs: Iterable[TracedPair],
) -> Iterator[TracedAnswer]:
    stereo = load_calibration(calibration)
    settings = dataclasses.replace(default_settings(stereo), needle_width=scene.diameter)
    for told in Told:
        reference = empty if told is Told.EMPTY_PHANTOM else None
        tracker = TipTracker(stereo, dataclasses.replace(settings, reference=reference))
        for pair in pairs:
            insertion = None if told is Told.NOTHING else pair.insertion
            tip = tracker.process(*pair.images, insertion).tip
            truth = None if pair.truth is None else pair.truth.tip
            if truth is None or pair.number >= SETTLED:
                yield TracedAnswer(scene, told, tip, truth)
