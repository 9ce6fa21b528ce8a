"""Step B: the paper's results reproduced, then beaten: studies of 10,000 needles each."""

from __future__ import annotations

import dataclasses
import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

from needle_bringup.installed import find_executable
from needle_bringup.verification import Check, Finding, Workbench
from needle_common.errors import UserError

AT_END = "converged_at_end"
LAST_20 = "converged_last_20"
SEED = "20090201"
ALL_TROUBLES = ("--outliers", "0.05", "--dropped", "0.2", "--delay", "1", "--kappa-patches", "0.2")
"""Together with 20 deg of play."""


@dataclasses.dataclass(frozen=True)
class Study:
    """One study, and what it must show.

    Attributes
    ----------
    key : str
        Short name.
    options : tuple of str
        Of monte_carlo, beside the controller, the draws and the seed.
    at_least, at_most : dict
        Result's key to bound.
    """

    key: str
    options: tuple[str, ...]
    at_least: dict[str, float]
    at_most: dict[str, float] = dataclasses.field(default_factory=dict)


PAPER = (
    Study("paper_endpoint", (), {AT_END: 0.955}, {"wall_s": 0.2}),
    Study("paper_cell", ("--grid", "cell"), {AT_END: 0.98}),
)
BEST = (
    Study(
        "best",
        (),
        {AT_END: 0.999, LAST_20: 0.998},
        {
            "rms_last_20_mm": 0.25,
            "p95_last_20_mm": 0.48,
            "settle_median_mm": 40.0,
            "settle_p95_mm": 70.0,
            "rotation_mean_deg": 1500.0,
            "wall_s": 10.0,
        },
    ),
    Study("kappa_08", ("--kappa-scale", "0.8"), {AT_END: 0.998}),
    Study("kappa_12", ("--kappa-scale", "1.2"), {AT_END: 0.998}),
    *(Study(f"play_{d}", ("--play-deg", str(d)), {AT_END: 0.995}) for d in (10, 20, 30, 40)),
    *(Study(f"lag_{d}", ("--lag-mm", str(d)), {AT_END: 0.97}) for d in (4, 8)),
    Study("outliers", ("--outliers", "0.05"), {AT_END: 0.998}),
    Study("dropped", ("--dropped", "0.2"), {AT_END: 0.998}),
    Study("late", ("--delay", "1"), {AT_END: 0.998}),
    Study("all_troubles", (*ALL_TROUBLES, "--play-deg", "20"), {AT_END: 0.975}),
    Study("roll_120", ("--roll-deg", "180"), {AT_END: 0.965}),
    Study("roll_160", ("--roll-deg", "180", "--depth-mm", "160"), {AT_END: 0.985}),
    Study("x_120", ("--x-mm", "10"), {AT_END: 0.965}),
    Study("x_180", ("--x-mm", "10", "--depth-mm", "180"), {AT_END: 0.998}),
    Study("flips", ("--flips", "11"), {AT_END: 0.999}),
)


def paper(bench: Workbench) -> Iterator[Finding]:
    """Study the paper's observer and law on both grids."""
    for study in PAPER:
        yield from _findings("paper", study, bench.folder)


def best(bench: Workbench) -> Iterator[Finding]:
    """Study preset best, undisturbed and under each trouble."""
    for study in BEST:
        yield from _findings("best", study, bench.folder)


def _findings(controller: str, study: Study, folder: Path) -> Iterator[Finding]:
    result = _run(controller, study, folder / f"{study.key}.json")
    bounds = [(key, bound, True) for key, bound in study.at_least.items()]
    bounds += [(key, bound, False) for key, bound in study.at_most.items()]
    for key, bound, is_least in bounds:
        value = result[key]
        passed = value is not None and (value >= bound if is_least else value <= bound)
        yield Finding(
            f"{study.key}_{key}",
            f"{controller} {' '.join(study.options) or '(undisturbed)'}: {key}",
            f"{'>=' if is_least else '<='} {bound:g}",
            "nothing" if value is None else f"{value:.4g}",
            passed,
        )


def _run(controller: str, study: Study, file: Path) -> dict[str, float | None]:
    command = [find_executable("needle_sim", "monte_carlo"), "--controller", controller]
    command += [*study.options, "--draws", "10", "--seed", SEED, "--json", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise UserError(f"{study.key}: {done.stderr.strip().splitlines()[-1]}")
    result: dict[str, float | None] = json.loads(file.read_text(encoding="utf-8"))
    return result


CHECKS: tuple[Check, ...] = (paper, best)
