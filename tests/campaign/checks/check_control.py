"""Step B: the paper's results and those of preset best, in studies of 10,000 needles each."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np

from campaign.checking import Check, Finding, Workbench
from campaign.checks.control_studies import (
    BEST,
    FIGURE_3,
    MISINFORMED,
    PAPER,
    POINTS,
    TROUBLE,
    WANDERING,
    Study,
    compare_figures,
    run,
)
from needle_bringup.studies.pure_insertions import curvature_errors

INSERTIONS = 3000


def paper(bench: Workbench) -> Iterator[Finding]:
    """Study the paper's observer and law on both grids."""
    return _studied(PAPER, bench)


def figure_3(bench: Workbench) -> Iterator[Finding]:
    """Settle from figure 3's start, over many noises."""
    return _studied((FIGURE_3,), bench)


def best(bench: Workbench) -> Iterator[Finding]:
    """Study preset best, undisturbed."""
    return _studied((BEST,), bench)


def trouble(bench: Workbench) -> Iterator[Finding]:
    """Study preset best under each disturbance, which it does not know."""
    return _studied(TROUBLE + MISINFORMED + WANDERING, bench)


def points(bench: Workbench) -> Iterator[Finding]:
    """Steer needles to points, at rest and moving, under unknown disturbances."""
    targets = ("--targets", "10000")
    asked = (dataclasses.replace(study, options=(*targets, *study.options)) for study in POINTS)
    return _studied(asked, bench)


def _studied(studies: Iterable[Study], bench: Workbench) -> Iterator[Finding]:
    for study in studies:
        yield from compare_figures(study, run(study, bench.folder))


def curvature(bench: Workbench) -> Iterator[Finding]:
    """Fit the curvature to a pure insertion of 60 mm."""
    off = curvature_errors(INSERTIONS, np.random.default_rng(60))
    yield Finding(
        "curvature_fit",
        f"1/kappa from {INSERTIONS} insertions of 60 mm, +-1 mm noise",
        "bias <= 0.5 %, spread <= 6.5 %",
        f"bias {off.bias:+.2%}, spread {off.spread:.2%} (a circle: kappa {off.circle_bias:+.0%})",
        abs(off.bias) <= 0.005 and off.spread <= 0.065,
    )


CHECKS: tuple[Check, ...] = (paper, figure_3, best, trouble, points, curvature)
