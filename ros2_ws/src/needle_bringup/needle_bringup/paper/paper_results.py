"""Trials and studies of [KC09] section IV, and their results."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from needle_bags.reading.bag_reader import Run, Series, read_run
from needle_bags.run.run_summary import reduced_states, target_offset
from needle_bringup.simulation import simulate_options
from needle_bringup.simulation.simulate import simulate
from needle_bringup.studies import monte_carlo_options
from needle_bringup.studies.pure_insertions import ARC, curvature_errors
from needle_bringup.studies.study_parts import parts_of, results_of
from needle_controller.curvature import identify_curvature
from needle_core.commands.cli import JsonValue

Floats = npt.NDArray[np.float64]
Columns = Mapping[str, Floats]

INITIAL = "-3,2,15"
TORSION = ("--play-deg", "10", "--lag-mm", "2")
TRIALS = ("2,15", "0,0", "1,-20", "-1,25", "-2,-15", "2,-10", "3,20", "-3,10", "0,-30")
"""Pitch and roll [deg] of the nine trials of figure 4; the first is also figure 3's."""
QUICK_TRIALS = 3
GRIDS = ("endpoint", "cell")
SCALES = (0.8, 0.9, 1.1, 1.2)
DEPTH_MM = 120.0
LONGER_MM = 240.0
DOMAIN_X_MM = 20.0
DOMAIN_PITCH_DEG = 40.0
DOMAIN_ROLL_DEG = 90.0
GOAL_MM = 1.0


class Laboratory:
    """Runner of trials and studies, in this process.

    Parameters
    ----------
    folder : Path
        Folder for the bags of the trials.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def trial(self, name: str, *arguments: str) -> Run:
        """Run a trial with the arguments of `simulate`, and read its bag.

        Raises
        ------
        UserError
            If it fails; missing the plane is not an error.
        """
        print(f"running {name} ...", file=sys.stderr, flush=True)
        bag = self._folder / name
        with contextlib.redirect_stdout(io.StringIO()):
            simulate(simulate_options.parse([*arguments, "--bag", str(bag)]))
        return read_run(bag)

    def study(self, name: str, *arguments: str) -> tuple[dict[str, JsonValue], Columns]:
        """Run a study with the arguments of `monte_carlo`; return its figures and its runs."""
        print(f"running {name} ...", file=sys.stderr, flush=True)
        parts = parts_of(monte_carlo_options.parse(arguments))
        results = results_of(parts, [part.run() for part in parts])
        return dict(results.figures), results.columns

    def identify(self, trial: str, *arguments: str) -> dict[str, JsonValue]:
        """Return the figures of `identify_curvature` for the bag of a trial."""
        options = identify_curvature.parse([str(self._folder / trial), *arguments])
        return identify_curvature.summary(*identify_curvature.identify(options))


@dataclasses.dataclass(frozen=True)
class SteeringTrial:
    """One trial: measurement, estimate and truth over the insertion.

    Attributes
    ----------
    insertion_mm : ndarray, shape (N,)
        Insertion depth at each exposure.
    measured_mm, estimate, truth : ndarray, shapes (N,), (N, 3), (N, 3)
        Measured r1; estimated and true r = (x [mm], pitch [deg], roll [deg]).
    rotation_deg : ndarray, shape (N,)
        Accumulated rotation of the base at each exposure.
    """

    insertion_mm: Floats
    measured_mm: Floats
    estimate: Floats
    truth: Floats
    rotation_deg: Floats


class PaperRuns:
    """All runs of the paper's section IV.

    Parameters
    ----------
    laboratory : Laboratory
        Executes the runs.
    seed : int
        Seed of all noise.
    quick : bool
        Whether to run fewer trials, and one draw instead of ten.

    Attributes
    ----------
    open_loop, closed_loop : SteeringTrial
        The first two columns of figure 3.
    trials : list of SteeringTrial
        Trials of figure 4; the first is the third column of figure 3.
    start : dict
        Figures of many runs from the start of figure 3.
    grids : dict
        Figures of the study on each grid, by name of the grid.
    runs, longer : dict
        Single runs of those studies, and the same runs inserted deeper.
    scales, scales_longer : dict
        Figures of the study with a wrong curvature, by the ratio of the plant's curvature to the
        assumed one, at the study's depth and deeper.
    domain_pitch, domain_roll : mapping
        Single runs from starts over (x, pitch) and over (x, roll).
    best : dict
        Figures of preset `best` on the endpoint grid.
    curvature : dict
        Result of `identify_curvature` for a pure insertion with cameras.
    curvature_errors : CurvatureErrors
        Errors of the curvature over many pure insertions with the paper's noise.
    """

    def __init__(self, laboratory: Laboratory, seed: int, *, quick: bool) -> None:
        trial, study = laboratory.trial, laboratory.study
        at = ("--controller", "paper", "--seed", str(seed))
        draws = ("--draws", "1" if quick else "10")
        self.trials = [
            read_trial(
                trial(
                    f"trial_{number}",
                    *("--level", "camera", "--controller", "paper", *TORSION),
                    *(f"--initial=-3,{start}", "--seed", str(seed + number - 1)),
                )
            )
            for number, start in enumerate(TRIALS[: QUICK_TRIALS if quick else None], 1)
        ]
        tip = ("--level", "tip", f"--initial={INITIAL}", "--seed", str(seed))
        open_loop = (*tip, "--controller", "open_loop", "--noise-mm", "0")
        self.open_loop = read_trial(trial("open_loop", *open_loop))
        closed_loop = (*tip, "--controller", "paper", "--noise-mm", "0.5")
        self.closed_loop = read_trial(trial("closed_loop", *closed_loop))
        trial(
            "pure_insertion",
            *("--level", "camera", "--controller", "open_loop", "--seed", str(seed)),
            *("--initial=0,0,90", "--depth-mm", f"{ARC * 1e3:g}"),
        )
        far = ("--depth-mm", f"{LONGER_MM:g}")
        self.grids, self.runs, self.longer = {}, {}, {}
        for grid in GRIDS:
            on = (*at, *draws, "--grid", grid)
            self.grids[grid], self.runs[grid] = study(f"study_{grid}", *on)
            _, self.longer[grid] = study(f"longer_{grid}", *on, *far)
        anywhere = (*at, "--grid", "random", "--x-mm", f"{DOMAIN_X_MM:g}", *draws)
        pitched = ("--pitch-deg", f"{DOMAIN_PITCH_DEG:g}", "--roll-deg", "0")
        _, self.domain_pitch = study("domain_pitch", *anywhere, *pitched)
        rolled = ("--pitch-deg", "0", "--roll-deg", f"{DOMAIN_ROLL_DEG:g}")
        _, self.domain_roll = study("domain_roll", *anywhere, *rolled)
        self.scales, self.scales_longer = {}, {}
        for scale in SCALES:
            wrong = (*at, *draws, "--kappa-scale", str(scale))
            self.scales[scale], _ = study(f"scale_{scale:g}", *wrong)
            self.scales_longer[scale], _ = study(f"scale_{scale:g}_longer", *wrong, *far)
        self.start, _ = study("start", *at, f"--initial={INITIAL}", "--noise-mm", "0.5")
        self.best, _ = study("best", "--controller", "best", "--seed", str(seed), *draws)
        # Skip the first 5 mm, where the needle is not visible and the tracker reports predictions.
        self.curvature = laboratory.identify("pure_insertion", "--from-mm", "5")
        many = 300 if quick else 3000
        self.curvature_errors = curvature_errors(many, np.random.default_rng(seed))


def read_trial(run: Run) -> SteeringTrial:
    """Return the trial in a bag, at the exposures common to all its series."""
    offset = target_offset(run)
    stamps = run.reduced_state.stamps
    for series in (run.tips, run.truth, run.control_input):
        stamps = np.intersect1d(stamps, series.stamps)
    truth = Series(stamps, _rows(run.truth, stamps), stamps)
    return SteeringTrial(
        insertion_mm=run.insertion_at(stamps) * 1e3,
        measured_mm=(_rows(run.tips, stamps)[:, 0] - offset) * 1e3,
        estimate=_readable(_rows(run.reduced_state, stamps)),
        truth=_readable(reduced_states(truth, offset)),
        rotation_deg=np.rad2deg(_rows(run.control_input, stamps)[:, 2]),
    )


def final_r1_mm(trial: SteeringTrial) -> float:
    """Return the true r1 at a trial's end [mm]."""
    return float(trial.truth[-1, 0])


def settled_mm(insertion_mm: Floats, r1_mm: Floats) -> float:
    """Return the insertion from which r1 stays within +-1 mm [mm]; infinite if it never does."""
    outside = np.flatnonzero(np.abs(r1_mm) > GOAL_MM)
    if outside.size == 0:
        return float(insertion_mm[0])
    after = int(outside[-1]) + 1
    return float(insertion_mm[after]) if after < len(insertion_mm) else float("inf")


def missed_later(runs: Columns, longer: Columns) -> tuple[int, int, float]:
    """Count the runs that missed at 120 mm and also at the greater depth; find the worst of them.

    Returns
    -------
    missed, still : int
        Number of runs that missed at 120 mm, and of those that missed at both depths.
    worst : float
        Largest |r1| [mm] at the greater depth among the runs that had missed; 0 if none had.
    """
    missed = np.abs(runs["r1_final_mm"]) > GOAL_MM
    later = np.abs(longer["r1_final_mm"][missed])
    return int(np.sum(missed)), int(np.sum(later > GOAL_MM)), float(np.max(later, initial=0.0))


def _rows(series: Series, stamps: npt.NDArray[np.int64]) -> Floats:
    return series.values[series.at(stamps)[0]]


def _readable(reduced: Floats) -> Floats:
    angles = np.rad2deg(np.unwrap(reduced[:, 1:], axis=0))
    return np.column_stack([reduced[:, 0] * 1e3, angles])
