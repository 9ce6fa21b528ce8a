"""Figures of `docs/paper.md`: figures 3 and 4 of [KC09], and its study."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from needle_bags.figures.figure_style import ESTIMATE, GOAL_BAND, INK, STYLE
from needle_bringup.paper.paper_results import (
    DEPTH_MM,
    DOMAIN_PITCH_DEG,
    DOMAIN_ROLL_DEG,
    DOMAIN_X_MM,
    GOAL_MM,
    LONGER_MM,
    Columns,
    Floats,
    PaperRuns,
    SteeringTrial,
)

MEAN = "#b5179e"
_DOTS: dict[str, Any] = {
    "marker": "o",
    "linestyle": "none",
    "markersize": 2.6,
    "markerfacecolor": "none",
    "markeredgecolor": "#55585e",
    "markeredgewidth": 0.6,
}


def figures_of(results: PaperRuns) -> Mapping[str, Figure]:
    """Return all figures by file name."""
    with mpl.rc_context(STYLE):
        return {
            "paper_figure_3": figure_3(results),
            "paper_figure_4": figure_4(results.trials),
            "paper_study": study_figure(results),
            "paper_domain": domain_figure(results),
        }


def figure_3(results: PaperRuns) -> Figure:
    """Draw three columns: open loop, closed loop, and a trial without its truth."""
    figure = Figure(figsize=(9.0, 7.6), layout="constrained")
    grid = figure.subplots(4, 3, sharex=True, squeeze=False)
    columns = (
        ("open loop, simulated", results.open_loop, True, False),
        ("closed loop, simulated", results.closed_loop, True, True),
        ("closed loop, by cameras", results.trials[0], False, True),
    )
    for column, (title, trial, truth_known, measured) in enumerate(columns):
        axes = grid[:, column]
        axes[0].set_title(title)
        axes[0].axhspan(-GOAL_MM, GOAL_MM, color=GOAL_BAND, alpha=0.15, lw=0)
        if measured:
            axes[0].plot(trial.insertion_mm, trial.measured_mm, **_DOTS, label="measured")
        states = trial.truth if truth_known else trial.estimate
        color, label = (INK, "truth") if truth_known else (ESTIMATE, "estimate")
        for row in range(3):
            axes[row].plot(trial.insertion_mm, states[:, row], color=color, lw=1.5, label=label)
            axes[row].axhline(0.0, color="#9aa0a8", lw=0.8, ls="--")
        axes[0].legend(loc="best")
        axes[3].plot(trial.insertion_mm, trial.rotation_deg, color=INK, lw=1.3)
        axes[3].set_xlabel("insertion [mm]")
        if not np.any(trial.rotation_deg):
            axes[3].set_ylim(-1.0, 1.0)
    for row, name in enumerate(("r1 [mm]", "r2, pitch [deg]", "r3, roll [deg]", "rotation [deg]")):
        grid[row, 0].set_ylabel(name)
    return figure


def figure_4(trials: list[SteeringTrial]) -> Figure:
    """Draw mean and standard deviation of r1 over the trials, and the trial of figure 3."""
    figure = Figure(figsize=(6.6, 3.6), layout="constrained")
    axes = figure.add_subplot()
    insertion, r1 = common_r1(trials)
    mean, std = r1.mean(axis=0), r1.std(axis=0)
    axes.axhspan(-GOAL_MM, GOAL_MM, color=GOAL_BAND, alpha=0.15, lw=0, label="±1 mm")
    axes.fill_between(insertion, mean - std, mean + std, color="#c9ccd1", lw=0, label="± std")
    axes.plot(insertion, mean, color=MEAN, lw=1.8, label=f"mean of {len(trials)} trials")
    axes.plot(insertion, r1[0], color=ESTIMATE, lw=1.4, label="the trial of figure 3")
    axes.axhline(0.0, color=INK, lw=0.9, ls="--")
    axes.set(xlabel="insertion [mm]", ylabel="r1, estimated [mm]")
    axes.legend(loc="lower right")
    return figure


def study_figure(results: PaperRuns) -> Figure:
    """Draw the distances of the study's runs from the plane, at the study's depth and deeper."""
    figure = Figure(figsize=(8.4, 3.4), layout="constrained")
    share, later = figure.subplots(1, 2)
    for grid, color in (("endpoint", MEAN), ("cell", ESTIMATE)):
        for runs, style, depth in (
            (results.runs[grid], "-", DEPTH_MM),
            (results.longer[grid], ":", LONGER_MM),
        ):
            off = np.sort(np.abs(runs["r1_final_mm"]))
            missing = 1.0 - np.arange(len(off)) / len(off)
            share.semilogy(off, missing, style, color=color, label=f"{grid}, {depth:.0f} mm")
    share.axvline(GOAL_MM, color=GOAL_BAND, lw=1.2)
    share.set(title="Share of runs farther off than", xlabel="|r1| at the end [mm]")
    share.legend(loc="best")
    runs, longer = results.runs["endpoint"], results.longer["endpoint"]
    missed = np.abs(runs["r1_final_mm"]) > GOAL_MM
    later.axhspan(-GOAL_MM, GOAL_MM, color=GOAL_BAND, alpha=0.15, lw=0)
    later.plot(
        runs["r1_final_mm"][missed],
        longer["r1_final_mm"][missed],
        ".",
        color=MEAN,
        markersize=4,
        alpha=0.6,
    )
    later.set(
        title="Runs that missed: later, against at the end",
        xlabel=f"r1 at {DEPTH_MM:.0f} mm [mm]",
        ylabel=f"r1 at {LONGER_MM:.0f} mm [mm]",
    )
    return figure


def domain_figure(results: PaperRuns) -> Figure:
    """Draw the share of converging runs over the initial state."""
    figure = Figure(figsize=(8.4, 3.8), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    image: Any = None
    for axis, runs, name, bound, box in (
        (axes[0], results.domain_pitch, "pitch", DOMAIN_PITCH_DEG, 10.0),
        (axes[1], results.domain_roll, "roll", DOMAIN_ROLL_DEG, 30.0),
    ):
        shares = converged_share(runs, f"{name}_deg", bound)
        image = axis.imshow(
            shares,
            origin="lower",
            extent=(-bound, bound, -DOMAIN_X_MM, DOMAIN_X_MM),
            aspect="auto",
            cmap="viridis",
            vmin=0.0,
            vmax=1.0,
        )
        axis.grid(visible=False)
        axis.plot([-box, box, box, -box, -box], [-3, -3, 3, 3, -3], color="white", lw=1.2)
        axis.set_xlabel(f"{name} at the start [deg]")
    axes[0].set(ylabel="r1 at the start [mm]", title="roll 0")
    axes[1].set_title("pitch 0")
    figure.colorbar(image, ax=axes, label="share within ±1 mm at the end")
    return figure


def common_r1(trials: list[SteeringTrial]) -> tuple[Floats, Floats]:
    """Return insertion [mm], (M,), and the trials' estimated r1 there [mm], (trials, M)."""
    deepest = min(float(trial.insertion_mm[-1]) for trial in trials)
    insertion = np.arange(0.0, deepest + 0.5)
    r1 = [np.interp(insertion, trial.insertion_mm, trial.estimate[:, 0]) for trial in trials]
    return insertion, np.array(r1)


def converged_share(runs: Columns, angle: str, bound: float, cells: int = 20) -> Floats:
    """Return the share of runs that converged, over x (rows) and an angle (columns)."""
    where = [
        np.linspace(-DOMAIN_X_MM, DOMAIN_X_MM, cells + 1),
        np.linspace(-bound, bound, cells + 1),
    ]
    converged = np.abs(runs["r1_final_mm"]) <= GOAL_MM
    every, *_ = np.histogram2d(runs["x_mm"], runs[angle], bins=where)
    good, *_ = np.histogram2d(runs["x_mm"][converged], runs[angle][converged], bins=where)
    return np.asarray(np.divide(good, every, out=np.full_like(good, np.nan), where=every > 0))
