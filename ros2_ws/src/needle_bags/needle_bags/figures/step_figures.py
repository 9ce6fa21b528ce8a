"""Figures of each step: innovation, gate, and duration of the stages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogFormatter

from needle_bags.figures.figure_style import (
    AXES,
    DOTTED,
    ESTIMATE,
    GREY,
    INK,
    MEASURED,
    MM,
    PLUM,
    RED,
    STYLE,
    TEAL,
    WIDTH,
    place,
)
from needle_bags.reading.bag_reader import Run, Stamps
from needle_bags.run.innovation import (
    QUANTILE_95,
    Innovations,
    gate_room,
    missed_tips,
    rejected_tips,
)
from needle_bags.run.stage_timing import StageTiming


def innovation_figure(run: Run, found: Innovations) -> Figure:
    """Return innovation, its normalised square, and the margin to the gate."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 6.6))
        place(figure, 3)
        parts, size, gate = figure.subplots(3, 1, sharex=True)
        insertion = run.insertion_at(found.stamps) * MM
        band = 2.0 * found.sigmas[:, 0] * MM
        label = "±2 sigma expected in x"
        parts.fill_between(insertion, -band, band, color=MEASURED, alpha=0.14, lw=0, label=label)
        for column, (name, style) in enumerate(AXES.items()):
            parts.plot(insertion, found.values[:, column] * MM, **style, label=name)
        parts.axhline(0.0, color=GREY, lw=0.8)
        # The band of the first tips would exceed the range of all others.
        top = 1.25 * max(np.abs(found.values).max() * MM, float(np.median(band)))
        parts.set(title="Innovation: measured minus expected tip", ylabel="mm", ylim=(-top, top))
        parts.legend(loc="best", ncols=2)
        size.plot(insertion, np.maximum(found.squared, 1e-3), ".", color=INK, ms=4)
        size.axhline(QUANTILE_95, color=RED, lw=1.1, label="95 % of tips expected below")
        size.axhline(3.0, color=GREY, lw=0.9, ls=(0, (4, 2)), label="expected average: 3")
        size.set(title="Innovation squared, normalised by its covariance")
        _scale_by_tens(size)
        size.legend(loc="best", ncols=2)
        _draw_gate(gate, run)
        gate.set_xlabel("insertion [mm]")
        return figure


def _draw_gate(axes: Any, run: Run) -> None:
    room = gate_room(run)
    insertion = run.insertion_at(room.stamps) * MM
    axes.plot(insertion, room.jump * MM, color=ESTIMATE, lw=1.1, label="jump beyond the insertion")
    axes.plot(
        insertion,
        room.reach * MM,
        color=TEAL,
        lw=1.3,
        ls=DOTTED,
        label="distance beyond the insertion",
    )
    top = 1.0
    if room.margin is not None:
        top = room.margin * MM
        axes.axhline(top, color=RED, lw=1.2, label="a tip above this is rejected")
    marks: Sequence[tuple[Stamps, str, str, str]] = (
        (rejected_tips(run), "x", RED, "refused"),
        (missed_tips(run), "|", MEASURED, "no tip found"),
    )
    for stamps, marker, color, label in marks:
        if len(stamps):
            where = run.insertion_at(stamps) * MM
            height = np.full(len(stamps), top)
            axes.plot(where, height, marker, color=color, ms=8, mew=1.6, label=label)
    axes.set(title="The controller's gate: tips beyond the needle's reach", ylabel="mm")
    axes.legend(loc="best", ncols=2)


def timing_figure(run: Run, timings: Sequence[StageTiming]) -> Figure:
    """Return the wall time of the stages of every step."""
    marks = ("o", "^", "s", "x", "+", "v")
    colors = (ESTIMATE, MEASURED, PLUM, RED, INK, TEAL)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 3.6))
        place(figure, 1, bottom=1.0)
        axes = figure.subplots()
        for timing, color, mark in zip(timings, colors, marks, strict=False):
            insertion = run.insertion_at(timing.stamps) * MM
            milliseconds = np.maximum(timing.seconds * 1e3, 1e-2)
            axes.plot(insertion, milliseconds, mark, ms=3, color=color, label=timing.name)
        axes.set(ylabel="ms", xlabel="insertion [mm]", title="Time for each step")
        _scale_by_tens(axes)
        figure.legend(loc="lower center", ncols=3)
        return figure


def _scale_by_tens(axes: Any) -> None:
    """Make a logarithmic axis with plain numbers; rendering typeset powers is slow."""
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(LogFormatter())


def timing_rows(timings: Sequence[StageTiming]) -> list[tuple[str, ...]]:
    """Return (stage, from what to what, steps, median, 95 %, 99 %, largest [ms]) as text."""
    rows: list[tuple[str, ...]] = []
    for timing in timings:
        figures: npt.NDArray[np.float64] = np.percentile(timing.seconds, [50, 95, 99, 100]) * 1e3
        numbers = (f"{value:.1f}" for value in figures)
        rows.append((timing.name, timing.meaning, str(len(timing.seconds)), *numbers))
    return rows
