"""Figure and table of the duration of the stages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogFormatter

from needle_bags.figures.figure_style import (
    ESTIMATE,
    INK,
    MEASURED,
    MM,
    PLUM,
    RED,
    TEAL,
    stacked,
)
from needle_bags.reading.bag_reader import Run
from needle_bags.run.stage_timing import StageTiming

_MARKS = ("o", "^", "s", "x", "+", "v")
_COLORS = (ESTIMATE, MEASURED, PLUM, RED, INK, TEAL)


def timing_figure(run: Run, timings: Sequence[StageTiming]) -> Figure:
    """Draw the wall time of each stage at every step."""
    with stacked(1, 3.6, bottom=1.0) as (figure, (axes,)):
        for timing, color, mark in zip(timings, _COLORS, _MARKS, strict=False):
            insertion = run.insertion_at(timing.stamps) * MM
            milliseconds = np.maximum(timing.seconds * 1e3, 1e-2)
            axes.plot(insertion, milliseconds, mark, ms=3, color=color, label=timing.name)
        axes.set(ylabel="ms", xlabel="insertion [mm]", title="Time for each step", yscale="log")
        # The default powers of ten are slow to render.
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(LogFormatter())
        figure.legend(loc="lower center", ncols=3)
        return figure


def timing_rows(timings: Sequence[StageTiming]) -> list[tuple[str, ...]]:
    """Return (stage, meaning, steps, median, 95 %, 99 %, largest [ms]) as text."""
    rows: list[tuple[str, ...]] = []
    for timing in timings:
        figures = np.percentile(timing.seconds, [50, 95, 99, 100]) * 1e3
        numbers = (f"{value:.1f}" for value in figures)
        rows.append((timing.name, timing.meaning, str(len(timing.seconds)), *numbers))
    return rows
