"""Timeline of a run: states, hold, warnings and faults."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from operator import itemgetter
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from needle_bags.figures.figure_style import (
    ESTIMATE,
    GOAL_BAND,
    GREY,
    MEASURED,
    RED,
    STYLE,
    WIDTH,
)
from needle_bags.reading.bag_reader import Run
from needle_bags.run.run_summary import health_of, is_aborted, trips

_STATE_COLORS = {
    "STEERING": ESTIMATE,
    "MOVING": ESTIMATE,
    "HOLDING": "#8fb8d8",
    "DONE": GOAL_BAND,
    "WAITING_FOR_TIP": MEASURED,
    "FAULT": RED,
    "ESTOPPED": RED,
}
_QUIET = "#d4d8dd"
_LEVEL_COLORS = {1: MEASURED, 2: RED, 3: GREY}
_LEVEL_NAMES = {1: "warning", 2: "error", 3: "stale"}
_MAX_PARTS = 12
_MIN_LENGTH = 0.004


class Span(NamedTuple):
    """Coloured part of a lane from `begin` to `end`, system clock [ns]."""

    begin: int
    end: int
    color: str


def lanes_of(run: Run) -> dict[str, list[Span]]:
    """Return the lanes by name: controller, device, hold, then the parts with problems."""
    end = _end(run)
    lanes = {}
    for name, statuses in (("controller", run.controller_status), ("device", run.device_status)):
        states = ((s.log_time, s.values.get("state", "")) for s in statuses)
        lanes[name] = _spans([(t, _STATE_COLORS.get(state, _QUIET)) for t, state in states], end)
    pressed = zip(run.holds.received.tolist(), run.holds.values[:, 0] > 0.5, strict=True)
    lanes["hold"] = _spans([(time, GOAL_BAND if held else None) for time, held in pressed], end)
    aborted = [result.log_time for result in run.results if is_aborted(result)]
    lanes["aborted steps"] = [Span(time, time, RED) for time in aborted]
    tripped = [event.log_time for event in trips(run)]
    lanes["watchdogs"] = [Span(time, time, MEASURED) for time in tripped]
    health = health_of(run)
    for part in list(dict.fromkeys(event.part for event in health))[:_MAX_PARTS]:
        events = [event for event in health if event.part == part]
        lanes[part] = _spans([(e.log_time, _LEVEL_COLORS.get(e.level)) for e in events], end)
    return {name: spans for name, spans in lanes.items() if spans}


def event_figure(run: Run) -> Figure | None:
    """Draw the lanes over the wall time since the first command; None without lanes."""
    lanes = lanes_of(run)
    if not lanes:
        return None
    spans = [span for lane in lanes.values() for span in lane]
    first = min(span.begin for span in spans)
    start = first if run.first_command is None else run.first_command
    shortest = _MIN_LENGTH * (_end(run) - first)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 1.5 + 0.3 * len(lanes)), layout="constrained")
        axes = figure.subplots()
        for row, lane in enumerate(lanes.values()):
            begins = np.array([span.begin - start for span in lane])
            lengths = np.array([max(span.end - span.begin, shortest) for span in lane])
            bars = np.column_stack([begins, lengths]) * 1e-9
            colors = [span.color for span in lane]
            axes.broken_barh(bars.tolist(), (row - 0.36, 0.72), color=colors, lw=0)
        axes.set_yticks(range(len(lanes)), list(lanes))
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        axes.set_axisbelow(True)
        axes.set_xlabel("wall time since the first command [s]")
        _legend(figure, {span.color for span in spans})
        return figure


def level_name(level: int) -> str:
    """Return the name of a diagnostic level."""
    return _LEVEL_NAMES.get(level, "?")


def _spans(changes: Sequence[tuple[int, str | None]], end: int) -> list[Span]:
    """Return the periods between changes of colour (time [ns], colour); None draws no span."""
    groups = itertools.groupby(changes, key=itemgetter(1))
    begins = [(next(group)[0], color) for color, group in groups]
    ends = [*(time for time, _ in begins[1:]), end]
    return [Span(t, e, c) for (t, c), e in zip(begins, ends, strict=False) if c is not None]


def _end(run: Run) -> int:
    times = [s.log_time for s in (*run.controller_status, *run.device_status)]
    times += [result.log_time for result in run.results]
    times += [event.log_time for event in run.health]
    times += [int(run.joints.received.max())] if len(run.joints) else []
    return max(times, default=0)


def _legend(figure: Figure, colors: set[str]) -> None:
    words = (
        (ESTIMATE, "steering, moving"),
        (_STATE_COLORS["HOLDING"], "holding"),
        (GOAL_BAND, "hold pressed, done"),
        (MEASURED, "waiting, warning"),
        (RED, "fault, error"),
        (_QUIET, "idle"),
    )
    handles = [Patch(color=color, label=text) for color, text in words if color in colors]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
