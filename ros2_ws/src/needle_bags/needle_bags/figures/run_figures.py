"""Figures of states, path and errors over the insertion, of one run or of two."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from needle_bags.figures.figure_style import (
    BROAD,
    ESTIMATE,
    GREY,
    MEASURED,
    MM,
    draw_goal,
    stacked,
)
from needle_bags.reading.bag_reader import Run, Series
from needle_bags.run.run_summary import (
    commanded_rotation,
    estimate_error,
    finite_tips,
    reduced_states,
    rerun_of,
    target_offset,
    tip_error,
)

Floats = npt.NDArray[np.float64]

_COLORS = {"A, ": ESTIMATE, "B, ": MEASURED}
_CIRCLES: dict[str, Any] = {
    "marker": "o",
    "linestyle": "none",
    "markersize": 3.6,
    "markerfacecolor": "none",
    "markeredgecolor": MEASURED,
    "markeredgewidth": 0.9,
}


def run_figures(runs: Sequence[Run]) -> dict[str, Figure]:
    """Return the figures of one run, or of two in comparison, by name."""
    figures = {"states": _states(runs), "path": _path(runs)}
    if any(len(tip_error(run)) for run in runs):
        figures["errors"] = _errors(runs)
    return figures


def is_same_needle(runs: Sequence[Run]) -> bool:
    """Return whether one run is a rerun of the other, so that both show the same insertion."""
    first, second = (run.joints.values for run in runs)
    return any(rerun_of(run) for run in runs) and np.array_equal(first, second)


def _needles(runs: Sequence[Run]) -> list[tuple[str, dict[str, Any], Run]]:
    """Return (prefix of labels, style, run) of each needle; one if both runs share it."""
    if len(runs) == 1 or is_same_needle(runs):
        return [("" if len(runs) == 1 else "A and B, ", BROAD, runs[0])]
    return [
        (prefix, {**BROAD, "color": color, "alpha": 0.45}, run)
        for (prefix, color), run in zip(_COLORS.items(), runs, strict=True)
    ]


def _controllers(runs: Sequence[Run]) -> list[tuple[str, dict[str, Any], Run]]:
    """Return (prefix of labels, style, run) of each controller."""
    colors = {"": ESTIMATE} if len(runs) == 1 else _COLORS
    return [
        (prefix, {"color": color, "lw": 1.3}, run)
        for (prefix, color), run in zip(colors.items(), runs, strict=True)
    ]


def _states(runs: Sequence[Run]) -> Figure:
    """Draw the four rows of [KC09] figure 3: r1, r2, r3 and the accumulated rotation."""
    with stacked(4, 7.6) as (figure, rows):
        draw_goal(rows[0])
        for prefix, style, run in _needles(runs):
            values = reduced_states(run.truth, target_offset(run))
            truth = dataclasses.replace(run.truth, values=values)
            _draw_states(rows, run, truth, **style, label=f"{prefix}truth")
            insertion, rotation = run.joints.values.T
            label = f"{prefix}base of the needle, measured"
            rows[3].plot(insertion * MM, np.degrees(rotation), **style, label=label)
        for prefix, style, run in _controllers(runs):
            _draw_states(rows, run, run.reduced_state, **style, label=f"{prefix}estimate")
            words = "would have commanded, step by step" if rerun_of(run) else "commanded"
            rows[3].plot(*_commands(run), **style, label=prefix + words)
        if len(runs) == 1:
            measured = (run.tips.values[:, 0] - target_offset(run)) * MM
            rows[0].plot(_insertion_mm(run, run.tips), measured, **_CIRCLES, label="measured")
        rows[0].set(title="Distance from the target plane  (r1)", ylabel="mm")
        rows[1].set(title="Pitch: angle between the needle and the plane  (r2)", ylabel="deg")
        rows[2].set(title="Roll: where the bevel points  (r3)", ylabel="deg")
        rows[3].set(title="Accumulated rotation", ylabel="deg", xlabel="insertion [mm]")
        for axes in (rows[0], rows[3]):
            axes.legend(loc="best", ncols=2)
        for axes in rows[1:3]:
            axes.axhline(0.0, color=GREY, lw=0.8)
        return figure


def _draw_states(rows: Sequence[Any], run: Run, states: Series, **style: Any) -> None:
    insertion = _insertion_mm(run, states)
    rows[0].plot(insertion, states.values[:, 0] * MM, **style)
    for column in (1, 2):
        rows[column].plot(insertion, np.degrees(np.unwrap(states.values[:, column])), **style)


def _commands(run: Run) -> tuple[Floats, Floats]:
    """Return insertion [mm] and commanded rotation [deg]; for a rerun, one line per step."""
    if not rerun_of(run):
        return _insertion_mm(run, run.control_input), np.degrees(run.control_input.values[:, 2])
    insertion, begin, end = commanded_rotation(run).T
    gap = np.full(len(begin), np.nan)
    along = np.stack([insertion, run.commands.values[:, 0], gap], axis=1).ravel()
    return along * MM, np.degrees(np.stack([begin, end, gap], axis=1).ravel())


def _path(runs: Sequence[Run]) -> Figure:
    """Draw the needles from the side, relative to the plane, and from above."""
    with stacked(2, 5.2) as (figure, (side, above)):
        draw_goal(side)
        for prefix, style, run in _needles(runs):
            plane, tips = target_offset(run), finite_tips(run)
            x, y, z = (run.truth if len(run.truth) else tips).values[:, :3].T * MM
            side.plot(z, x - plane * MM, **style, label=f"{prefix}needle")
            above.plot(z, y, **style)
            if len(runs) == 1:
                x, y, z = tips.values.T * MM
                side.plot(z, x - plane * MM, **_CIRCLES, label="measured tip")
                above.plot(z, y, **_CIRCLES)
        side.set(title="Seen from the side; the target plane is 0", ylabel="x - plane [mm]")
        above.set(title="Seen from above", ylabel="y [mm]", xlabel="z, insertion direction [mm]")
        side.legend(loc="best", ncols=2)
        return figure


def _errors(runs: Sequence[Run]) -> Figure:
    """Draw the errors of measurement and estimate with respect to the truth."""
    with stacked(4, 7.6) as (figure, rows):
        for prefix, style, run in _controllers(runs):
            tips, error = finite_tips(run), tip_error(run) * MM
            insertion = run.insertion_at(tips.stamps[tips.at(run.truth.stamps)[0]]) * MM
            distance = np.linalg.norm(error, axis=1)
            rows[0].plot(insertion, distance, **style, label=f"{prefix}3D distance")
            depth = {**style, "lw": 1.0, "ls": (0, (4, 2))}
            rows[0].plot(insertion, error[:, 0], **depth, label=f"{prefix}in depth (x)")
            stamps, error = estimate_error(run, run.reduced_state)
            errors = dataclasses.replace(run.reduced_state, stamps=stamps, values=error)
            _draw_states(rows[1:], run, errors, **style)
        for axes in rows[1:]:
            axes.axhline(0.0, color=GREY, lw=0.8)
        rows[0].set(title="Measured tip minus truth", ylabel="mm")
        rows[1].set(title="Estimated r1 minus truth", ylabel="mm")
        rows[2].set(title="Estimated pitch minus truth", ylabel="deg")
        rows[3].set(title="Estimated roll minus truth", ylabel="deg", xlabel="insertion [mm]")
        rows[0].legend(loc="best", ncols=2)
        return figure


def _insertion_mm(run: Run, series: Series) -> Floats:
    return run.insertion_at(series.stamps) * MM
