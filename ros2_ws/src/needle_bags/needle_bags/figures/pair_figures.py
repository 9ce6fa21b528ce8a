"""Figures that compare two runs."""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from needle_bags.figures.figure_style import (
    ESTIMATE,
    GOAL_BAND,
    GREY,
    MEASURED,
    MM,
    STYLE,
    TRUTH,
    WIDTH,
    place,
)
from needle_bags.reading.bag_reader import Run
from needle_bags.run.run_summary import (
    GOAL,
    commanded_rotation,
    estimate_error,
    finite_tips,
    reduced_states,
    rerun_of,
    target_offset,
    tip_error,
)

Floats = npt.NDArray[np.float64]

LETTERS = ("A", "B")
_COLORS = (ESTIMATE, MEASURED)
_ROWS = (
    ("Distance from the target plane  (r1)", "mm"),
    ("Pitch  (r2)", "deg"),
    ("Roll  (r3)", "deg"),
    ("Accumulated rotation, measured", "deg"),
    ("Rotation commanded for each step", "deg"),
)


def pair_figures(first: Run, second: Run) -> dict[str, Figure]:
    """Return the figures by name."""
    runs = (first, second)
    figures = {"pair_states": _states(runs), "pair_path": _path(runs)}
    if any(len(tip_error(run)) for run in runs):
        figures["pair_errors"] = _errors(runs)
    return figures


def is_same_needle(runs: tuple[Run, Run]) -> bool:
    """Return whether both runs are of one insertion, because one is a rerun."""
    first, second = (run.joints.values for run in runs)
    return any(rerun_of(run) for run in runs) and np.array_equal(first, second)


def _needles(runs: tuple[Run, Run]) -> list[tuple[str, str, Run]]:
    """Return (letter, colour, run) of each needle; one if both runs share it."""
    if is_same_needle(runs):
        return [("A and B", TRUTH, runs[0])]
    return list(zip(LETTERS, _COLORS, runs, strict=True))


def _states(runs: tuple[Run, Run]) -> Figure:
    """Draw the rows of figure 3, truth broad and estimate thin, and the commands."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 10.4))
        place(figure, 5, bottom=1.0)
        rows = figure.subplots(5, 1, sharex=True)
        rows[0].axhspan(-GOAL * MM, GOAL * MM, color=GOAL_BAND, alpha=0.16, lw=0)
        for letter, color, run in _needles(runs):
            truth = reduced_states(run.truth, target_offset(run))
            style = {"color": color, "lw": 3.6, "alpha": 0.45, "label": f"{letter}, truth"}
            _draw_states(rows, run, truth, run.truth.stamps, **style)
            if len(run.joints):
                insertion, rotation = run.joints.values.T
                rows[3].plot(insertion * MM, np.degrees(rotation), color=color, lw=1.4)
        for letter, color, run in zip(LETTERS, _COLORS, runs, strict=True):
            estimate = run.reduced_state
            style = {"color": color, "lw": 1.2, "label": f"{letter}, estimate"}
            _draw_states(rows, run, estimate.values, estimate.stamps, **style)
            insertion, begin, end = commanded_rotation(run).T
            words = "would have commanded" if rerun_of(run) else "commanded"
            rows[4].plot(
                insertion * MM,
                np.degrees(end - begin),
                color=color,
                lw=1.1,
                label=f"{letter} {words}",
            )
        for axes, (title, unit) in zip(rows, _ROWS, strict=True):
            axes.set(title=title, ylabel=unit)
        rows[4].set_xlabel("insertion [mm]")
        handles = [
            line for axes in (rows[0], rows[4]) for line in axes.get_legend_handles_labels()[0]
        ]
        figure.legend(handles=handles, loc="lower center", ncols=3)
        return figure


def _draw_states(rows: Any, run: Run, states: Floats, stamps: Any, **style: Any) -> None:
    if not len(stamps):
        return
    insertion = run.insertion_at(stamps) * MM
    rows[0].plot(insertion, states[:, 0] * MM, **style)
    for column in (1, 2):
        angles = np.degrees(np.unwrap(states[:, column]))
        rows[column].plot(insertion, angles, **style)


def _path(runs: tuple[Run, Run]) -> Figure:
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 5.2))
        place(figure, 2)
        side, above = figure.subplots(2, 1, sharex=True)
        side.axhspan(-GOAL * MM, GOAL * MM, color=GOAL_BAND, alpha=0.16, lw=0)
        for letter, color, run in _needles(runs):
            path = (run.truth.values[:, :3] if len(run.truth) else finite_tips(run).values) * MM
            offset = target_offset(run) * MM
            side.plot(path[:, 2], path[:, 0] - offset, color=color, lw=1.5, label=letter)
            above.plot(path[:, 2], path[:, 1], color=color, lw=1.5)
        side.set(title="Seen from the side; the target plane is 0", ylabel="x - plane [mm]")
        above.set(title="Seen from above", ylabel="y [mm]", xlabel="z, insertion direction [mm]")
        side.legend(loc="best", ncols=2)
        return figure


def _errors(runs: tuple[Run, Run]) -> Figure:
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 7.0))
        place(figure, 3)
        tip, r1, roll = figure.subplots(3, 1, sharex=True)
        for letter, color, run in zip(LETTERS, _COLORS, runs, strict=True):
            tips = finite_tips(run)
            here, _ = tips.at(run.truth.stamps)
            insertion = run.insertion_at(tips.stamps[here]) * MM
            distance = np.linalg.norm(tip_error(run), axis=1) * MM
            tip.plot(insertion, distance, color=color, lw=1.2, label=letter)
            stamps, error = estimate_error(run, run.reduced_state)
            insertion = run.insertion_at(stamps) * MM
            r1.plot(insertion, error[:, 0] * MM, color=color, lw=1.2)
            roll.plot(insertion, np.degrees(error[:, 2]), color=color, lw=1.2)
        for axes in (r1, roll):
            axes.axhline(0.0, color=GREY, lw=0.8)
        tip.set(title="Measured tip: 3D distance from the truth", ylabel="mm")
        r1.set(title="Estimated r1 minus truth", ylabel="mm")
        roll.set(title="Estimated roll minus truth", ylabel="deg", xlabel="insertion [mm]")
        tip.legend(loc="best", ncols=2)
        return figure
