"""The studies of step B: what is asked of `monte_carlo`, and what it must answer."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path

from campaign.checking import Finding
from needle_core.errors import UserError
from needle_core.files.installed import find_executable

AT_END = "converged_at_end"
LAST_20 = "converged_last_20"
TRUSTED_FAR_OFF = "trusted_far_off"
SEED = "20090201"
RUNS_A_DRAW = 1000
ALL_TROUBLES = ("--outliers", "0.05", "--dropped", "0.2", "--delay", "1", "--kappa-patches", "0.2")
"""Together with 20 deg of play."""
NORMAL = ("--noise-mm", "0.577", "--noise-shape", "normal")
"""Noise of the same variance as the claimed +-1 mm has."""
MIXED = (
    *("--noise-mm", "1.2", "--outliers", "0.03", "--outlier-mm", "2,5", "--dropped", "0.1"),
    *("--slip", "0.03", "--kappa-scale", "0.9", "--kappa-patches", "0.1", "--play-deg", "15"),
    *("--bump-mm", "1"),
)
"""A little of everything at once."""
# A study runs in one thread; numpy's others only wait, which counts as processor time too.
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}

Figures = Mapping[str, float | None]


@dataclasses.dataclass(frozen=True)
class Study:
    """One study, and what it must show.

    Attributes
    ----------
    key : str
        Short name.
    controller : str
        The preset.
    options : tuple of str
        Of monte_carlo, beside the controller, the draws and the seed.
    at_least, at_most : dict
        Result's key to bound.
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
FIGURE_3 = Study(
    "figure_3",
    "paper",
    ("--initial=-3,2,15", "--noise-mm", "0.5"),
    {},
    {"settle_median_mm": 50.0},
)
BEST = Study(
    "best",
    "best",
    (),
    {AT_END: 0.999, LAST_20: 0.998},
    {
        "rms_last_20_mm": 0.25,
        "p95_last_20_mm": 0.48,
        "settle_median_mm": 40.0,
        "settle_p95_mm": 70.0,
        "rotation_mean_deg": 1500.0,
        TRUSTED_FAR_OFF: 0.0,
    },
)
TROUBLE = tuple(
    Study(key, "best", options, {AT_END: least}, {TRUSTED_FAR_OFF: 0.0})
    for key, options, least in (
        ("kappa_08", ("--kappa-scale", "0.8"), 0.998),
        ("kappa_12", ("--kappa-scale", "1.2"), 0.998),
        *((f"play_{d}", ("--play-deg", str(d)), 0.995) for d in (10, 20, 30, 40)),
        *((f"lag_{d}", ("--lag-mm", str(d)), 0.97) for d in (4, 8)),
        ("outliers", ("--outliers", "0.05"), 0.998),
        ("dropped", ("--dropped", "0.2"), 0.998),
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
TOLD_WRONG = tuple(
    Study(
        key,
        "best",
        options,
        {AT_END: least, "inside_2_sigma": 0.93, "inside_3_sigma": 0.99},
        {TRUSTED_FAR_OFF: 0.0},
    )
    for key, options, least in (
        ("normal_noise", NORMAL, 0.999),
        ("lasting_5", (*NORMAL, "--noise-lasting", "0.5"), 0.97),
        ("lasting_8", (*NORMAL, "--noise-lasting", "0.8"), 0.9),
        ("noise_13", ("--noise-mm", "1.3"), 0.995),
        ("noise_20", ("--noise-mm", "2"), 0.97),
        *(
            (f"outliers_{key}", ("--outliers", "0.05", "--outlier-mm", size), 0.995)
            for key, size in (("far", "3,5"), ("near", "2,3.5"), ("nearest", "1.5,2.5"))
        ),
        *(
            (f"slip_{key}", ("--slip", share), least)
            for key, share, least in (
                ("2", "0.02", 0.995),
                ("5", "0.05", 0.99),
                ("10", "0.1", 0.97),
                ("minus_5", "-0.05", 0.99),
            )
        ),
        ("sigma_2", (*NORMAL, "--sigma-scale", "2"), 0.99),
        ("sigma_4", (*NORMAL, "--sigma-scale", "4"), 0.95),
        ("bump", ("--bump-mm", "2"), 0.95),
        ("mixed", MIXED, 0.97),
    )
)
"""What is claimed to `best` stays +-1 mm, or the standard deviation that such noise has."""
REACHED = "within_1_mm_point"
POINTS = (
    Study(
        "points",
        "best",
        (),
        {REACHED: 0.999},
        {"rms_point_mm": 0.20, "rotation_mean_deg": 1300.0, TRUSTED_FAR_OFF: 0.0},
    ),
    Study(
        "points_budget",
        "best",
        ("--rotation-deg", "1300"),
        {REACHED: 0.99},
        {"rotation_p95_deg": 1300.0, TRUSTED_FAR_OFF: 0.0},
    ),
    Study(
        "points_seen_well",
        "best",
        ("--noise-mm", "0.05", "--claimed-mm", "0.05"),
        {REACHED: 0.999},
        {"rms_point_mm": 0.10, TRUSTED_FAR_OFF: 0.0},
    ),
    Study(
        "points_moving",
        "best",
        ("--target-drift-mm", "2", "--target-breath-mm", "3"),
        {REACHED: 0.97},
        {"rms_point_mm": 0.40, TRUSTED_FAR_OFF: 0.0},
    ),
    *(
        Study(f"points_{key}", "best", options, {REACHED: 0.97}, {TRUSTED_FAR_OFF: 0.0})
        for key, options in (
            ("normal_noise", NORMAL),
            ("noise_13", ("--noise-mm", "1.3")),
            ("outliers_near", ("--outliers", "0.05", "--outlier-mm", "2,3.5")),
            ("slip_5", ("--slip", "0.05")),
            ("sigma_2", (*NORMAL, "--sigma-scale", "2")),
            ("play_40", ("--play-deg", "40")),
            ("lag_8", ("--lag-mm", "8")),
            ("bump", ("--bump-mm", "2")),
            ("late_untold", ("--untold-delay", "3")),
        )
    ),
)
"""Needles to points, each to one of its own."""
SPEED = (
    Study("speed_paper", "paper", (), {}, {"cpu_s": 0.2}),
    Study("speed_best", "best", (), {}, {"cpu_s": 10.0}),
)


@dataclasses.dataclass(frozen=True)
class Measured:
    """A study that was run.

    Attributes
    ----------
    figures : mapping
        What `--json` has.
    peak_memory : float
        Largest resident memory of the process [bytes].
    """

    figures: Figures
    peak_memory: float


def run(study: Study, folder: Path, draws: int, seed: str = SEED) -> Measured:
    """Run a study in a process of its own.

    Parameters
    ----------
    study : Study
        Which.
    folder : Path
        Takes its file.
    draws : int
        Runs from each of the 1000 starts.
    seed : str
        Of all randomness.

    Raises
    ------
    UserError
        If it does not run.
    """
    file, said = folder / f"{study.key}.json", folder / f"{study.key}.txt"
    command = [find_executable("needle_sim", "monte_carlo"), "--controller", study.controller]
    command += [*study.options, "--draws", str(draws), "--seed", seed, "--json", str(file)]
    with said.open("wb") as output:
        process = subprocess.Popen(
            command, env={**os.environ, **ONE_THREAD}, stdout=output, stderr=subprocess.STDOUT
        )
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        last = ["", *said.read_text("utf-8", errors="replace").strip().splitlines()][-1]
        raise UserError(f"{study.key}: {last}")
    return Measured(json.loads(file.read_text(encoding="utf-8")), usage.ru_maxrss * 1024.0)


def judge(study: Study, figures: Figures, draws: int) -> Iterator[Finding]:
    """Compare a study's figures with what they must be.

    Fewer than the full 10,000 runs get the benefit of the doubt: a share may fall short of its
    bound by three standard deviations of what that many runs would show.
    """
    runs = RUNS_A_DRAW * draws
    bounds = [(*bound, True) for bound in study.at_least.items()]
    for key, bound, is_least in (*bounds, *((*bound, False) for bound in study.at_most.items())):
        value = figures[key]
        slack = 3.0 * math.sqrt(bound * (1.0 - bound) / runs) if is_least and draws < 10 else 0.0
        passed = value is not None and (value >= bound - slack if is_least else value <= bound)
        yield Finding(
            f"{study.key}_{key}",
            f"{study.controller} {' '.join(study.options) or '(undisturbed)'}: {key}",
            f"{'>=' if is_least else '<='} {bound:g}",
            "nothing" if value is None else f"{value:.4g} of {runs} runs",
            passed,
        )
