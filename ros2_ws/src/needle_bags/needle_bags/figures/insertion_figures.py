"""Figures of states, path and errors over the insertion, in mm and degrees."""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from needle_bags.figures.figure_style import (
    AXES,
    BROAD,
    DASHED,
    DOTTED,
    GOAL_BAND,
    GREY,
    INK,
    MEASURED,
    MM,
    PLUM,
    STYLE,
    TEAL,
    THIN,
    WIDTH,
    place,
)
from needle_bags.reading.bag_reader import Run, Series
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

_MEASURED_DOTS: dict[str, Any] = {
    "marker": "o",
    "linestyle": "none",
    "markersize": 3.6,
    "markerfacecolor": "none",
    "markeredgecolor": MEASURED,
    "markeredgewidth": 0.9,
}


def states_figure(run: Run) -> Figure:
    """Return the four rows of [KC09] figure 3: r1, r2, r3 and the accumulated rotation."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 7.6))
        place(figure, 4)
        r1, r2, r3, rotation = figure.subplots(4, 1, sharex=True)
        _goal_band(r1)
        _draw_measured(r1, run)
        offset = target_offset(run)
        truth, estimate = reduced_states(run.truth, offset), run.reduced_state
        for axes, column, factor in ((r1, 0, MM), (r2, 1, None), (r3, 2, None)):
            for series, values, style in (
                (run.truth, truth, {**BROAD, "label": "truth"}),
                (estimate, estimate.values, {**THIN, "label": "estimate"}),
            ):
                shown = values[:, column] if len(series) else np.empty(0)
                scaled = shown * factor if factor else np.degrees(np.unwrap(shown))
                axes.plot(_insertion_mm(run, series), scaled, **style)
        r1.set(title="Distance from the target plane  (r1)", ylabel="mm")
        r1.legend(loc="best", ncols=4)
        r2.set(title="Pitch: angle between the needle and the plane  (r2)", ylabel="deg")
        r3.set(title="Roll: where the bevel points  (r3)", ylabel="deg")
        if len(run.joints):
            rotation.plot(
                run.joints.values[:, 0] * MM,
                np.degrees(run.joints.values[:, 1]),
                **BROAD,
                label="base of the needle, measured",
            )
        if rerun_of(run):
            _draw_rerun_commands(rotation, run)
        elif len(run.control_input):
            rotation.plot(
                _insertion_mm(run, run.control_input),
                np.degrees(run.control_input.values[:, 2]),
                **THIN,
                label="commanded",
            )
        rotation.set(title="Accumulated rotation", ylabel="deg", xlabel="insertion [mm]")
        if rotation.lines:
            rotation.legend(loc="best")
        for axes in (r2, r3):
            axes.axhline(0.0, color=GREY, lw=0.8)
        return figure


def _draw_rerun_commands(axes: Any, run: Run) -> None:
    """Draw the commands of a rerun: a line for each step, from the recorded rotation."""
    insertion, begin, end = commanded_rotation(run).T
    step = run.commands.values[:, 0]
    gap = np.full(len(begin), np.nan)
    axes.plot(
        np.stack([insertion, step, gap], axis=1).ravel() * MM,
        np.degrees(np.stack([begin, end, gap], axis=1).ravel()),
        **THIN,
        label=f"{run.parameter('plane_controller', 'preset')} would have rotated it, step by step",
    )


def path_figure(run: Run) -> Figure:
    """Return the needle's path: from the side against the plane, from above, and in space."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 6.0))
        place(figure, 2, gap=0.85)
        grid = figure.add_gridspec(2, 2, height_ratios=[1.0, 1.5])
        side = figure.add_subplot(grid[0, :])
        above = figure.add_subplot(grid[1, 0])
        # A grid would cut off its labels.
        space = figure.add_axes((0.53, 0.06, 0.42, 0.44), projection="3d")
        tips = finite_tips(run).values * MM
        truth = run.truth.values[:, :3] * MM
        plane = target_offset(run) * MM
        side.axhspan(plane - GOAL * MM, plane + GOAL * MM, color=GOAL_BAND, alpha=0.16, lw=0)
        side.axhline(plane, color=GOAL_BAND, lw=1.3, label="target plane, ±1 mm")
        side.plot(truth[:, 2], truth[:, 0], **BROAD, label="needle (truth)")
        side.plot(tips[:, 2], tips[:, 0], **_MEASURED_DOTS, label="measured tip")
        side.set(
            title="Seen from the side: the target plane is the green line",
            xlabel="z, insertion direction [mm]",
            ylabel="x, up [mm]",
        )
        side.legend(loc="best", ncols=3)
        above.plot(truth[:, 2], truth[:, 1], **BROAD)
        above.plot(tips[:, 2], tips[:, 1], **_MEASURED_DOTS)
        above.set(title="Seen from above", xlabel="z [mm]", ylabel="y [mm]")
        above.set_aspect("equal", adjustable="datalim")
        _draw_space(space, truth if len(truth) else tips, plane)
        return figure


def error_figure(run: Run) -> Figure:
    """Return the errors of measurement and estimate against the truth."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 5.0))
        place(figure, 2, right=0.7)
        tip, difference = figure.subplots(2, 1, sharex=True)
        error = tip_error(run) * MM
        tips = finite_tips(run)
        here, _ = tips.at(run.truth.stamps)
        insertion = run.insertion_at(tips.stamps[here]) * MM
        norm = np.linalg.norm(error, axis=1)
        tip.plot(insertion, norm, **BROAD, label="3D distance")
        for column, (name, style) in enumerate(AXES.items()):
            tip.plot(insertion, error[:, column], **style, label=name)
        tip.set(title="Measured tip minus truth", ylabel="mm")
        tip.legend(loc="best", ncols=2)
        stamps, error = estimate_error(run, run.reduced_state)
        insertion = run.insertion_at(stamps) * MM
        angles = difference.twinx()
        angles.grid(visible=False)
        angles.spines["right"].set_visible(True)
        lines = difference.plot(insertion, error[:, 0] * MM, **THIN, label="r1 [mm]")
        degrees = np.degrees(error)
        lines += angles.plot(
            insertion, degrees[:, 1], color=PLUM, lw=1.1, ls=DASHED, label="r2 [deg]"
        )
        lines += angles.plot(
            insertion, degrees[:, 2], color=TEAL, lw=1.1, ls=DOTTED, label="r3 [deg]"
        )
        difference.set(title="Estimate minus truth", ylabel="mm", xlabel="insertion [mm]")
        angles.set_ylabel("deg")
        difference.legend(lines, [str(line.get_label()) for line in lines], loc="best", ncols=3)
        return figure


def _goal_band(axes: Any) -> None:
    axes.axhspan(-GOAL * MM, GOAL * MM, color=GOAL_BAND, alpha=0.16, lw=0, label="±1 mm")
    axes.axhline(0.0, color=GOAL_BAND, lw=1.1)


def _draw_measured(axes: Any, run: Run) -> None:
    measured = (run.tips.values[:, 0] - target_offset(run)) * MM
    axes.plot(_insertion_mm(run, run.tips), measured, **_MEASURED_DOTS, label="measured")


def _draw_space(axes: Any, path: Floats, plane: float) -> None:
    axes.set_title("In space")
    if not len(path):
        return
    low, high = path.min(axis=0), path.max(axis=0)
    reach = max(float((high - low)[:2].max()) / 2, 4.0) * 1.2
    middle = float(low[1] + high[1]) / 2
    z, y = np.meshgrid([float(low[2]), float(high[2])], [middle - reach, middle + reach])
    axes.plot_surface(z, y, np.full_like(z, plane), color=GOAL_BAND, alpha=0.22, linewidth=0)
    axes.plot(path[:, 2], path[:, 1], path[:, 0], color=INK, lw=1.9)
    axes.plot(path[:, 2], path[:, 1], np.full(len(path), plane), color=GREY, lw=0.9)
    axes.set_xlabel("z [mm]", labelpad=9)
    axes.set_ylabel("y [mm]", labelpad=5)
    axes.set_zlabel("x [mm]", labelpad=2)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(4))
    axes.tick_params(labelsize=8)
    axes.set_box_aspect((2.2, 1.0, 0.9), zoom=0.78)
    axes.view_init(elev=22, azim=-62)


def _insertion_mm(run: Run, series: Series) -> Floats:
    return run.insertion_at(series.stamps) * MM
