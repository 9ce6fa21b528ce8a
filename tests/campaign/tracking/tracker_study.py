"""The tracker over rendered insertions: errors, states and times, as arrays."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import find_scenario
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_tracker.filter.measurement import TrackState
from needle_tracker.filter.needle_tracker import NeedleTracker
from needle_tracker.optics.calibration import StereoCalibration, load_calibration
from needle_tracker.tracker_parameters import StereoTrackerParameters

Array = NDArray[np.float64]

WRONG = 1.5e-3
_SEEN = 0.95  # visible share of the last 10 mm in both cameras from which the needle must be found
STEP = 1e-3
FIRST_STEP = 6
SPACING = 5e-4
CURVATURE = 8.2
# Distance from the axis at which the bevel is turned back [m].
_STRAY = 4e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Exposure:
    """One stereo pair and its truth.

    Attributes
    ----------
    insertion : float
        Length of needle in the phantom [m].
    T_rig_tip : ndarray, shape (4, 4)
        The tip's true pose.
    left, right : ndarray of uint8, shape (height, width)
        The images.
    visible : pair of float
        Visible share of the last 10 mm in the left and the right image.
    """

    insertion: float
    T_rig_tip: NDArray[np.float64]
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    visible: tuple[float, float]


def insertion_sequence(
    calibration: Path, scenario: str, seed: int, steps: int, noise: float | None = None
) -> Iterator[Exposure]:
    """Yield one exposure for each millimetre of a simulated insertion.

    The bevel is turned at random, from held to spun, and back where the needle leaves the axis.

    Parameters
    ----------
    calibration : Path
        The rig's calibration file.
    scenario : str
        Scenario of the renderer.
    seed : int
        Seed of the renderer, the start and the steering; not negative.
    steps : int
        Number of exposures, from 6 mm of insertion on.
    noise : float, optional
        Standard deviation of the sensor's noise, in place of the scenario's [grey levels].
    """
    disturbed_scenario = find_scenario(scenario)
    if noise is not None:
        disturbed_scenario = dataclasses.replace(disturbed_scenario, noise=noise)
    renderer = StereoRenderer(load_stereo_rig(calibration), seed, scenario=disturbed_scenario)
    rng = np.random.default_rng([seed, 41])
    pitch, roll = rng.uniform(-1.0, 1.0, 2) * (math.radians(5.0), math.pi)
    plant = NeedlePlant(initial_pose(float(pitch), float(roll)), curvature=CURVATURE)
    turn = 0.0
    for number in range(FIRST_STEP + steps):
        if number % 8 == 0:
            turn = float(rng.choice([0.0, 0.02, 0.06, 0.3]) * rng.choice([-1.0, 1.0]))
            turn += _turn_back(np.asarray(plant.T_rig_tip), 8)
        plant.advance(STEP, turn)
        if number < FIRST_STEP:
            continue
        pose = np.asarray(plant.T_rig_tip)
        path = plant.centreline(SPACING)
        left, right = renderer.render(pose, path, number)
        visible = renderer.visible_share(pose, path, number)
        yield Exposure(STEP * (number + 1), pose, left, right, visible)


def _turn_back(pose: NDArray[np.float64], steps: int) -> float:
    """Return the rotation per step that turns the bending towards the axis, 0 while near it."""
    sideways = pose[:2, 3] + 0.02 * pose[:2, 2]
    if float(np.hypot(*sideways)) < _STRAY:
        return 0.0
    # The needle bends towards -y of its own frame.
    direction = pose[:3, :3].T @ np.array([-sideways[0], -sideways[1], 0.0])
    return math.remainder(math.atan2(direction[0], -direction[1]), 2.0 * math.pi) / steps


@dataclasses.dataclass(frozen=True, eq=False)
class TrackedRun:
    """Answers of the tracker during one insertion, one for each exposure.

    Attributes
    ----------
    errors : ndarray, shape (n, 3)
        Tip less truth in `rig` [m]; NaN where there is no tip.
    normalized : ndarray, shape (n,)
        Squared error over its covariance; NaN where there is no tip.
    states : list of TrackState
        State after each pair.
    visible : ndarray of bool, shape (n,)
        Whether both cameras see the needle's end.
    seconds : ndarray, shape (n,)
        CPU time of the thread for each pair [s].
    """

    errors: Array
    normalized: Array
    states: list[TrackState]
    visible: NDArray[np.bool_]
    seconds: Array

    @property
    def found(self) -> NDArray[np.bool_]:
        """Whether there is a tip, for each exposure."""
        return np.asarray(np.isfinite(self.normalized))

    @property
    def distances(self) -> Array:
        """Lengths of the errors of all tips [m]."""
        return np.asarray(np.linalg.norm(self.errors[self.found], axis=1))

    @property
    def depths(self) -> Array:
        """Absolute errors of all tips in depth [m]."""
        return np.asarray(np.abs(self.errors[self.found, 0]))

    def slowest_recovery(self) -> int:
        """Return the largest number of pairs until a visible needle was found again."""
        longest = waiting = 0
        for visible, found in zip(self.visible, self.found, strict=True):
            waiting = 0 if found or not visible else waiting + 1
            longest = max(longest, waiting)
        return longest


def new_tracker(calibration: StereoCalibration) -> NeedleTracker:
    """Return a tracker with the defaults of the node."""
    return NeedleTracker(calibration, StereoTrackerParameters())


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
        The tracker; it is reset first.
    exposures : iterable of Exposure
        The insertion.
    searching : bool
        Whether the tracker is reset before every pair.
    """
    tracker.reset()
    errors, normalized, states, visible, seconds = [], [], [], [], []
    for exposure in exposures:
        if searching:
            tracker.reset()
        begin = time.thread_time()
        measured = tracker.process(exposure.left, exposure.right, exposure.insertion)
        seconds.append(time.thread_time() - begin)
        states.append(measured.state)
        visible.append(min(exposure.visible) >= _SEEN)
        error, square = np.full(3, np.nan), np.nan
        # In the entry zone, a tip may come from the insertion alone: it does not count as found.
        if measured.tip is not None and measured.state is not TrackState.ENTRY:
            error = measured.tip.position - exposure.T_rig_tip[:3, 3]
            square = float(error @ np.linalg.solve(measured.tip.covariance, error))
        errors.append(error)
        normalized.append(square)
    return TrackedRun(
        np.array(errors), np.array(normalized), states, np.array(visible), np.array(seconds)
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
