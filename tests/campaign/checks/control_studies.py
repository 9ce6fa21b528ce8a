"""The studies of step B: options of `monte_carlo` and required figures."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from campaign.checking import Finding, at_least, at_most
from needle_core.errors import UserError
from needle_core.files.installed import find_executable

AT_END = "converged_at_end"
LAST_20 = "converged_last_20"
TRUSTED_FAR_OFF = "trusted_far_off"
SEED = "20090201"
ALL_TROUBLES = ("--outliers", "0.05", "--found", "0.8", "--delay", "1", "--kappa-patches", "0.2")
"""Together with 20 deg of play."""
NORMAL = ("--noise-mm", "0.577", "--noise-shape", "normal")
"""Noise of the same variance as the claimed +-1 mm has."""
MIXED = (
    *("--noise-mm", "1.2", "--outliers", "0.03", "--outlier-mm", "2,5", "--found", "0.9"),
    *("--slip", "0.03", "--kappa-scale", "0.9", "--kappa-patches", "0.1", "--play-deg", "15"),
    *("--bump-mm", "1"),
)
"""A little of everything at once."""
# A study runs in one thread; idle threads of numpy would count as CPU time.
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}

Figures = Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class Study:
    """One study and its required figures.

    Attributes
    ----------
    key : str
        Short name.
    controller : str
        The preset.
    options : tuple of str
        Options of monte_carlo besides controller, draws and seed.
    at_least, at_most : dict
        Bounds by key of the result.
    """

    key: str
    controller: str
    options: tuple[str, ...]
    at_least: dict[str, float] = dataclasses.field(default_factory=dict)
    at_most: dict[str, float] = dataclasses.field(default_factory=dict)


PAPER = (
    Study("paper_endpoint", "paper", (), {AT_END: 0.955}),
    Study("paper_cell", "paper", ("--grid", "cell"), {AT_END: 0.98}),
)
_FIGURE_3 = ("--initial=-3,2,15", "--noise-mm", "0.5")
FIGURE_3 = Study("figure_3", "paper", _FIGURE_3, {}, {"settle_median_mm": 50.0})
_BEST_AT_MOST = {
    "rms_last_20_mm": 0.25,
    "p95_last_20_mm": 0.48,
    "settle_median_mm": 40.0,
    "settle_p95_mm": 70.0,
    "rotation_mean_deg": 1500.0,
    TRUSTED_FAR_OFF: 0.0,
}
BEST = Study("best", "best", (), {AT_END: 0.999, LAST_20: 0.998}, _BEST_AT_MOST)
TROUBLE = tuple(
    Study(key, "best", options, {AT_END: least}, {TRUSTED_FAR_OFF: 0.0})
    for key, options, least in (
        ("kappa_08", ("--kappa-scale", "0.8"), 0.998),
        ("kappa_12", ("--kappa-scale", "1.2"), 0.998),
        *((f"play_{d}", ("--play-deg", str(d)), 0.995) for d in (10, 20, 30, 40)),
        *((f"lag_{d}", ("--lag-mm", str(d)), 0.97) for d in (4, 8)),
        ("outliers", ("--outliers", "0.05"), 0.998),
        ("found", ("--found", "0.8"), 0.998),
        ("late", ("--delay", "1"), 0.998),
        ("late_untold", ("--untold-delay", "3"), 0.98),
        ("all_troubles", (*ALL_TROUBLES, "--play-deg", "20"), 0.975),
        ("roll_120", ("--roll-deg", "180"), 0.965),
        ("roll_160", ("--roll-deg", "180", "--depth-mm", "160"), 0.985),
        ("x_120", ("--x-mm", "10"), 0.965),
        ("x_180", ("--x-mm", "10", "--depth-mm", "180"), 0.998),
        ("flips", ("--flips", "11"), 0.999),
    )
)
_KNOWN = {"inside_2_sigma": 0.93, "inside_3_sigma": 0.99}
MISINFORMED = tuple(
    Study(key, "best", options, {AT_END: least, **_KNOWN}, {TRUSTED_FAR_OFF: 0.0})
    for key, options, least in (
        ("normal_noise", NORMAL, 0.999),
        ("lasting_5", ("--correlated", "0.5"), 0.97),
        ("lasting_8", ("--correlated", "0.8"), 0.9),
        ("noise_13", ("--noise-mm", "1.3"), 0.995),
        ("noise_20", ("--noise-mm", "2"), 0.97),
        ("outliers_far", ("--outliers", "0.05", "--outlier-mm", "3,5"), 0.995),
        ("outliers_near", ("--outliers", "0.05", "--outlier-mm", "2,3.5"), 0.995),
        ("outliers_nearest", ("--outliers", "0.05", "--outlier-mm", "1.5,2.5"), 0.995),
        ("slip_2", ("--slip", "0.02"), 0.995),
        ("slip_5", ("--slip", "0.05"), 0.99),
        ("slip_10", ("--slip", "0.1"), 0.97),
        ("slip_minus_5", ("--slip", "-0.05"), 0.99),
        ("sigma_2", (*NORMAL, "--sigma-scale", "2"), 0.99),
        ("sigma_4", (*NORMAL, "--sigma-scale", "4"), 0.95),
        ("bump", ("--bump-mm", "2"), 0.95),
        ("mixed", MIXED, 0.97),
    )
)
"""Wrong assumptions: `best` still assumes +-1 mm, or the standard deviation of that noise."""
WANDERING = tuple(
    Study(key, "best", options, at_least)
    for key, options, at_least in (
        ("push_1", ("--push", "1"), {AT_END: 0.995}),
        ("push_2", ("--push", "2"), {AT_END: 0.95}),
        ("gain_95", ("--rotation-gain", "0.95"), {AT_END: 0.999}),
        ("gain_80", ("--rotation-gain", "0.8"), {AT_END: 0.92}),
        ("roll_walk_2", ("--roll-walk", "2"), {AT_END: 0.99}),
        ("roll_walk_5", ("--roll-walk", "5"), {AT_END: 0.8}),
        ("correlated_9", ("--correlated", "0.9"), {AT_END: 0.88}),
        ("bias_walk", ("--bias-walk", "1"), {AT_END: 0.85, "x_inside_3_sigma": 0.97}),
        ("camera", ("--claimed-mm", "0.03", "--bias-walk", "0.3"), {"x_inside_3_sigma": 0.95}),
        ("layer", ("--layer", "0.3,60"), {AT_END: 0.84}),
        ("found_30", ("--found", "0.3"), {AT_END: 0.99}),
        ("student", ("--student", "3,0.3"), {AT_END: 0.99}),
        ("step_2", ("--step-mm", "2"), {AT_END: 0.99}),
    )
)
"""Random walks of heading, roll or bias, and other disturbances."""
_COMPARED = (
    *("normal_noise", "noise_13", "noise_20", "outliers", "slip_5", "play_40", "lag_8", "kappa_08"),
    *("kappa_12", "late", "flips"),
)
COMPARED = {
    BEST.key: BEST,
    **{study.key: study for study in TROUBLE + MISINFORMED if study.key in _COMPARED},
    **{study.key: study for study in WANDERING},
}
"""Rows of the estimator table, by key."""
REACHED = "within_1_mm_point"
_WELL = ("--noise-mm", "0.05", "--claimed-mm", "0.05")
_MOVING = ("--target-drift-mm-per-s", "0.0333", "--target-breath-mm", "3")
POINTS = tuple(
    Study(f"points{key}", "best", options, {REACHED: least}, {**at_most, TRUSTED_FAR_OFF: 0.0})
    for key, options, least, at_most in (
        ("", (), 0.999, {"rms_point_mm": 0.20, "rotation_mean_deg": 1300.0}),
        ("_budget", ("--rotation-deg", "1300"), 0.99, {"rotation_p95_deg": 1300.0}),
        ("_seen_well", _WELL, 0.999, {"rms_point_mm": 0.10}),
        ("_moving", _MOVING, 0.97, {"rms_point_mm": 0.40}),
        ("_normal_noise", NORMAL, 0.97, {}),
        ("_noise_13", ("--noise-mm", "1.3"), 0.97, {}),
        ("_outliers_near", ("--outliers", "0.05", "--outlier-mm", "2,3.5"), 0.97, {}),
        ("_slip_5", ("--slip", "0.05"), 0.97, {}),
        ("_sigma_2", (*NORMAL, "--sigma-scale", "2"), 0.97, {}),
        ("_play_40", ("--play-deg", "40"), 0.97, {}),
        ("_lag_8", ("--lag-mm", "8"), 0.97, {}),
        ("_bump", ("--bump-mm", "2"), 0.97, {}),
        ("_late_untold", ("--untold-delay", "3"), 0.97, {}),
    )
)
"""Needles steered to points, each to another one."""


def run(study: Study, folder: Path) -> Figures:
    """Run a study in its own process: 10 needles from each of the 1000 starts.

    Raises
    ------
    UserError
        If the study fails.
    """
    file = folder / f"{study.key}.json"
    command = [find_executable("needle_sim", "monte_carlo"), "--controller", study.controller]
    command += [*study.options, "--draws", "10", "--seed", SEED, "--json", str(file)]
    done = subprocess.run(
        command, env={**os.environ, **ONE_THREAD}, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise UserError(f"{study.key}: {done.stderr.strip()}")
    return dict(json.loads(file.read_text(encoding="utf-8")))


def compare_figures(study: Study, figures: Figures) -> Iterator[Finding]:
    """Compare the figures of a study with the required ones."""
    what = f"{study.controller} {' '.join(study.options) or '(undisturbed)'}"
    for bounds, compare in ((study.at_least, at_least), (study.at_most, at_most)):
        for key, bound in bounds.items():
            # A missing figure is NaN, and meets no bound.
            value = math.nan if figures[key] is None else figures[key]
            yield compare(f"{study.key}_{key}", f"{what}: {key}", bound, value)
