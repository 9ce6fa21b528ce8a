"""Figures of estimators under all disturbances of `control_studies`.

python -m campaign.steering.estimator_table --needles 10000 --json now.json
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
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
from needle_sim.studies.study import run_study

ESTIMATORS = ("best", "ekf", "paper")
EDGES = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 0.7, 1.0)
"""Edges of the bins of the stated probability of a miss."""
_STARTS = 1000
Row = dict[str, Any]
"""Figures of one estimator under one disturbance; see `figures`."""


def steer(study: Study, estimator: str, needles: int) -> Row:
    """Return the figures of some needles of a study, steered by one estimator."""
    preset = "best" if estimator == "ekf" else estimator
    argv = ["--controller", preset, *study.options, "--seed", SEED]
    options = parse([*argv, "--draws", str(needles // _STARTS)])
    return figures(concatenate([_steered(part, estimator) for part in parts_of(options)]))


def _steered(part: StudyPart, estimator: str) -> Outcomes:
    if estimator != "ekf":
        outcomes = part.run()
        assert isinstance(outcomes, Outcomes)
        return outcomes
    options = part.options
    flips = tuple(np.linspace(0.0, options.depth, options.flips + 2)[1:-1].tolist())
    std = options.claimed_bound / math.sqrt(3.0) / options.sigma_scale
    return run_study(
        part.starts,
        lambda: EkfNeedles(std, flips, options.step_length),
        settings_of(options),
        first=part.first,
    )


def figures(outcomes: Outcomes) -> Row:
    """Return the figures of some needles.

    `within` is the share that ends within 1 mm of the plane, `rms_mm` the RMS distance over the
    last 20 mm. Of an estimator that states the probability of a miss, `inside` is the share of x
    over the last 20 mm within 3 standard deviations, `flagged` and `false_alarms` are the shares of
    the misses and of the others that were reported as doubtful, and `bins` has the needles, the sum
    of the stated probabilities and the misses of each bin.
    """
    missed, stated = ~outcomes.converged_at_end, outcomes.missed
    row: Row = {
        "within": float(1.0 - np.mean(missed)),
        "rms_mm": 1e3 * float(np.sqrt(np.mean(outcomes.x_last**2))),
        "misses": int(np.sum(missed)),
        "rotation_deg": float(np.rad2deg(np.mean(outcomes.rotation))),
    }
    if np.any(np.isnan(stated)):
        return row
    doubtful = is_doubtful(stated)
    row["inside"] = float(np.mean(outcomes.x_inside_3_sigma))
    for name, of in (("flagged", missed), ("false_alarms", ~missed)):
        row[name] = float(np.mean(doubtful[of])) if np.any(of) else None
    weights = np.ones_like(stated), stated, missed.astype(float)
    row["bins"] = [np.histogram(stated, EDGES, weights=each)[0].tolist() for each in weights]
    return row


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    argv = sys.argv[1:] if arguments is None else arguments
    return run_command(lambda: _run(argv))


def _run(argv: Sequence[str]) -> int:
    parser = CommandParser("estimator_table", "Compare estimators under all disturbances.", "")
    add = parser.add_argument
    add("--needles", default="10000", metavar="N", help="of each row (10000)")
    add("--only", default=",".join(COMPARED), metavar="KEYS", help="rows (default: all)")
    add("--estimators", default=",".join(ESTIMATORS), metavar="NAMES", help="names (default: all)")
    add("--json", metavar="FILE", help="also write all figures as JSON")
    given = parser.parse_args(argv)
    needles = whole_number("--needles", given.needles, _STARTS, 1_000_000)
    path = output_file("--json", given.json)
    keys, estimators = given.only.split(","), given.estimators.split(",")
    if unknown := {*keys} - {*COMPARED} or {*estimators} - {*ESTIMATORS}:
        raise UserError(f"no such row or estimator: {', '.join(sorted(unknown))}")
    table: dict[str, dict[str, Row]] = {key: {} for key in keys}
    for name in estimators:
        bins = np.zeros((3, len(EDGES) - 1))
        for key, rows in table.items():
            # The paper's law cannot flip, and is unstable with steps of 2 mm.
            if name == "paper" and {"--flips", "--step-mm"} & set(COMPARED[key].options):
                continue
            row = rows[name] = steer(COMPARED[key], name, needles)
            bins += row.get("bins", 0.0)
            texts = [f"{k} {v:.4g}" for k, v in row.items() if k != "bins" and v is not None]
            print(f"{name:6} {key:16} {', '.join(texts)}", flush=True)
        for (low, high), (count, stated, missed) in zip(pairwise(EDGES), bins.T, strict=True):
            if count:
                print(
                    f"{name:6} stated {low:g} to {high:g}: {count:.0f} needles, mean "
                    f"{stated / count:.4f}, missed {missed / count:.4f}"
                )
    if path is not None:
        path.write_text(json.dumps(table), encoding="utf-8")
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
