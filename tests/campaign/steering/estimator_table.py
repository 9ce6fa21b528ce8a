"""Table of estimators under all disturbances of `control_studies`.

python -m campaign.steering.estimator_table --needles 10000 --table table.md --json now.json
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from campaign.checks.control_studies import COMPARED, SEED, Study
from campaign.steering.ekf_needles import EkfNeedles
from needle_bringup.studies.monte_carlo_options import parse
from needle_bringup.studies.study_parts import StudyPart, parts_of, settings_of
from needle_core.commands.cli import EXIT_DONE, run_command
from needle_core.commands.options import CommandParser, output_file, whole_number
from needle_core.errors import UserError
from needle_sim.studies.figures_of_merit import Outcomes, concatenate, is_doubtful
from needle_sim.studies.study import Controller, run_study

ESTIMATORS = ("best", "ekf", "paper")
EDGES = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 0.7, 1.0)
"""Edges of the bins of the stated probability of a miss."""
_STARTS = 1000
Bins = list[tuple[int, float, int]]
"""Needles, sum of stated probabilities, and misses of each bin."""


@dataclasses.dataclass(frozen=True)
class Row:
    """Figures of one estimator under one disturbance.

    Attributes
    ----------
    within : float
        Share that ends within 1 mm of the plane.
    rms_mm : float
        RMS distance from the plane over the last 20 mm [mm].
    inside : float, optional
        Share of x over the last 20 mm within 3 standard deviations; None if the estimator states
        none, which also holds for the next three.
    misses : int
        Needles that end farther than 1 mm off.
    called : float, optional
        Share of the misses that were reported as doubtful.
    false_alarms : float, optional
        Share of the other needles that were reported as doubtful.
    bins : list of tuple
        See `Bins`; empty if no probabilities are stated.
    rotation_deg : float
        Mean rotation of the base [deg].
    cpu_s : float
        Processor time of all needles.
    """

    within: float
    rms_mm: float
    inside: float | None
    misses: int
    called: float | None
    false_alarms: float | None
    bins: Bins
    rotation_deg: float
    cpu_s: float


Table = dict[str, dict[str, Row]]
"""Rows by disturbance and estimator."""


def steer(study: Study, estimator: str, needles: int) -> Row:
    """Steer some needles of a study by one estimator."""
    preset = "best" if estimator == "ekf" else estimator
    words = ["--controller", preset, *study.options, "--seed", SEED]
    options = parse([*words, "--draws", str(needles // _STARTS)])
    begin = time.process_time()
    outcomes = [_steered(part, estimator) for part in parts_of(options)]
    return figures(concatenate(outcomes), time.process_time() - begin)


def _steered(part: StudyPart, estimator: str) -> Outcomes:
    options = part.options
    flips = tuple(np.linspace(0.0, options.depth, options.flips + 2)[1:-1].tolist())
    if estimator == "ekf":
        std = options.claimed_bound / math.sqrt(3.0) / options.sigma_scale

        def new() -> Controller:
            return EkfNeedles(std, flips, options.step_length)

        return run_study(part.starts, new, settings_of(options), first=part.first)
    outcomes = part.run()
    assert isinstance(outcomes, Outcomes)
    return outcomes


def figures(outcomes: Outcomes, cpu: float) -> Row:
    """Return the figures of some needles."""
    missed = ~outcomes.converged_at_end
    doubtful, stated = is_doubtful(outcomes.missed), outcomes.missed
    says = not np.any(np.isnan(stated))
    return Row(
        within=float(1.0 - np.mean(missed)),
        rms_mm=1e3 * float(np.sqrt(np.mean(outcomes.x_last**2))),
        inside=float(np.mean(outcomes.x_inside_3_sigma)) if says else None,
        misses=int(np.sum(missed)),
        called=float(np.mean(doubtful[missed])) if says and np.any(missed) else None,
        false_alarms=float(np.mean(doubtful[~missed])) if says and np.any(~missed) else None,
        bins=_bins(stated, missed) if says else [],
        rotation_deg=float(np.rad2deg(np.mean(outcomes.rotation))),
        cpu_s=cpu,
    )


def _bins(stated: Any, missed: Any) -> Bins:
    of = np.clip(np.searchsorted(EDGES, stated, side="right") - 1, 0, len(EDGES) - 2)
    return [
        (int(np.sum(of == k)), float(np.sum(stated[of == k])), int(np.sum(missed[of == k])))
        for k in range(len(EDGES) - 1)
    ]


def together(rows: Sequence[Row]) -> Bins:
    """Return the sum of the bins of some rows."""
    said = [row.bins for row in rows if row.bins]
    return [
        (sum(n for n, _, _ in same), sum(p for _, p, _ in same), sum(m for _, _, m in same))
        for same in zip(*said, strict=True)
    ]


def markdown(table: Table, estimators: Sequence[str]) -> str:
    """Return the table, and that of the stated probabilities, as markdown.

    Parameters
    ----------
    table : dict
        Figures by trouble and estimator; an estimator may lack a trouble.
    estimators : sequence of str
        Order of the estimators in each cell.
    """
    states = [
        name
        for name in estimators
        if any(name in rows and rows[name].bins for rows in table.values())
    ]
    lines = [
        f"Each cell: {', '.join(estimators)}; what is stated: {', '.join(states)}.",
        "",
        "| what happens | within 1 mm, % | RMS of the last 20 mm | x within 3 sigma, % | misses "
        "| of them called, % | false alarms, % | rotation, deg |",
        "|" + " --- |" * 8,
    ]
    for key, rows in table.items():
        cells = (
            _cell(rows, estimators, lambda row: f"{100 * row.within:.2f}"),
            _cell(rows, estimators, lambda row: f"{row.rms_mm:.2f}"),
            _cell(rows, states, lambda row: _percent(row.inside)),
            _cell(rows, states, lambda row: str(row.misses)),
            _cell(rows, states, lambda row: _percent(row.called)),
            _cell(rows, states, lambda row: _percent(row.false_alarms)),
            _cell(rows, estimators, lambda row: f"{row.rotation_deg:.0f}"),
        )
        lines.append(f"| {key} | {' | '.join(cells)} |")
    lines += [
        "",
        "Stated probability of a miss, and the share of misses in all rows together:",
        "",
        "| estimator | stated | needles | mean | missed |",
        "|" + " --- |" * 5,
    ]
    for name in states:
        bins = together([rows[name] for rows in table.values() if name in rows])
        for (low, high), (needles, stated, misses) in zip(pairwise(EDGES), bins, strict=True):
            if needles:
                lines.append(
                    f"| {name} | {low:g} to {high:g} | {needles} | {stated / needles:.4f} "
                    f"| {misses / needles:.4f} |"
                )
    return "\n".join(lines) + "\n"


def _cell(rows: Mapping[str, Row], names: Sequence[str], text: Callable[[Row], str]) -> str:
    return ", ".join(text(rows[name]) if name in rows else "-" for name in names)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    return run_command(lambda: _run(words))


def _run(words: Sequence[str]) -> int:
    parser = CommandParser("estimator_table", "Compare estimators under all disturbances.", "")
    add = parser.add_argument
    add("--needles", default="10000", metavar="N", help="of each row (10000)")
    add("--only", default="", metavar="KEYS", help="rows, separated by commas (default: all)")
    add("--estimators", default=",".join(ESTIMATORS), metavar="NAMES", help="names (default: all)")
    add("--json", metavar="FILE", help="write all figures as JSON")
    add("--table", metavar="FILE", help="write the table as Markdown")
    given = parser.parse_args(words)
    needles = whole_number("--needles", given.needles, _STARTS, 1_000_000)
    json_file, table_file = output_file("--json", given.json), output_file("--table", given.table)
    estimators = given.estimators.split(",")
    keys = given.only.split(",") if given.only else list(COMPARED)
    if unknown := {*keys} - {*COMPARED} or {*estimators} - {*ESTIMATORS}:
        raise UserError(f"no such row or estimator: {', '.join(sorted(unknown))}")
    table: Table = {}
    for key in keys:
        table[key] = {}
        for name in estimators:
            # The paper's law cannot flip, and is unstable with steps of 2 mm.
            if name == "paper" and {"--flips", "--step-mm"} & set(COMPARED[key].options):
                continue
            row = table[key][name] = steer(COMPARED[key], name, needles)
            print(
                f"{key:16} {name:6} {100 * row.within:6.2f} % {row.rms_mm:6.3f} mm  3 sigma "
                f"{_percent(row.inside)}  misses {row.misses}, called {_percent(row.called)}, "
                f"false {_percent(row.false_alarms)}  {row.cpu_s:.1f} s",
                flush=True,
            )
        if json_file is not None:
            # Write after each row, so that an interruption loses one row only.
            json_file.write_text(json.dumps(table, default=dataclasses.asdict), encoding="utf-8")
    text = markdown(table, estimators)
    print(text)
    if table_file is not None:
        table_file.write_text(text, encoding="utf-8")
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
