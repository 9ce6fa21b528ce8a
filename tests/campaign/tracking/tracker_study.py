"""The tracker over rendered insertions: errors, states and times, as arrays."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from campaign.tracking.tracker_sequences import Exposure, insertion_sequence
from needle_tracker.answers.tracker_parameters import default_settings
from needle_tracker.filter.measurement import TrackState
from needle_tracker.filter.needle_tracker import NeedleTracker
from needle_tracker.optics.calibration import StereoCalibration, load_calibration

Array = NDArray[np.float64]

WRONG = 1.5e-3
_SEEN = 0.95  # share of the last 10 mm in view, in both cameras: the needle is to be seen


@dataclasses.dataclass(frozen=True, eq=False)
class TrackedRun:
    """Answers of the tracker during one insertion, one for each exposure.

    Attributes
    ----------
    errors : ndarray, shape (n, 3)
        Tip less truth in `rig` [m]; NaN where there is no tip.
    normalised : ndarray, shape (n,)
        Squared error over its covariance; NaN where there is no tip.
    states : list of TrackState
        After each pair.
    seen : ndarray of bool, shape (n,)
        Whether both cameras see the needle's end.
    seconds : ndarray, shape (n,)
        Of the thread's own time, for each pair.
    """

    errors: Array
    normalised: Array
    states: list[TrackState]
    seen: NDArray[np.bool_]
    seconds: Array

    @property
    def found(self) -> NDArray[np.bool_]:
        """Tell whether there is a tip."""
        return np.asarray(np.isfinite(self.normalised))

    @property
    def distances(self) -> Array:
        """Length of the errors [m], of the tips there are."""
        return np.asarray(np.linalg.norm(self.errors[self.found], axis=1))

    @property
    def depths(self) -> Array:
        """Size of the errors along the cameras' depth [m], of the tips there are."""
        return np.asarray(np.abs(self.errors[self.found, 0]))

    def slowest_recovery(self) -> int:
        """Return the most pairs that it took to find the needle once it was seen again."""
        longest = waiting = 0
        for seen, found in zip(self.seen, self.found, strict=True):
            waiting = 0 if found or not seen else waiting + 1
            longest = max(longest, waiting)
        return longest


def new_tracker(calibration: StereoCalibration) -> NeedleTracker:
    """Return a tracker as the node's defaults make it."""
    return NeedleTracker(calibration, default_settings(calibration))


def track_run(
    tracker: NeedleTracker,
    exposures: Iterable[Exposure],
    *,
    searching: bool = False,
) -> TrackedRun:
    """Run a tracker over an insertion.

    Parameters
    ----------
    tracker : NeedleTracker
        Forgets what it knew.
    exposures : iterable of Exposure
        The insertion.
    searching : bool
        Whether it forgets again before every pair.
    """
    tracker.reset()
    errors, normalised, states, seen, seconds = [], [], [], [], []
    for exposure in exposures:
        if searching:
            tracker.reset()
        begin = time.thread_time()
        measured = tracker.process(exposure.left, exposure.right, exposure.insertion)
        seconds.append(time.thread_time() - begin)
        states.append(measured.state)
        seen.append(min(exposure.seen) >= _SEEN)
        error, square = np.full(3, np.nan), np.nan
        # In the entry zone a tip may be the stage's alone: it was not found.
        if measured.tip is not None and measured.state is not TrackState.ENTRY:
            error = measured.tip.position - exposure.T_rig_tip[:3, 3]
            square = float(error @ np.linalg.solve(measured.tip.covariance, error))
        errors.append(error)
        normalised.append(square)
    return TrackedRun(
        np.array(errors), np.array(normalised), states, np.array(seen), np.array(seconds)
    )


def run_scenario(
    calibration: Path, scenario: str, seeds: Iterable[int], steps: int, noise: float | None = None
) -> list[TrackedRun]:
    """Run the tracker over several insertions of one of the renderer's scenarios."""
    tracker = new_tracker(load_calibration(calibration))
    return [
        track_run(tracker, insertion_sequence(calibration, scenario, seed, steps, noise))
        for seed in seeds
    ]
