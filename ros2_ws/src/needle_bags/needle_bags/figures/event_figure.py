"""Time line of a run: states, hold, warnings and faults."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import matplotlib as mpl
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
from needle_bags.reading.bag_reader import HealthEvent, Run, Status
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


@dataclasses.dataclass(frozen=True)
class Span:
    """Coloured part of a lane from `begin` to `end`, system clock [ns]."""

    begin: int
    end: int
    color: str


@dataclasses.dataclass(frozen=True)
class Lane:
    """One row of the figure."""

    name: str
    spans: Sequence[Span]


def lanes_of(run: Run) -> list[Lane]:
    """Return the lanes of a run: controller, device, hold, then the parts with problems."""
    end = _end(run)
    lanes = [
        Lane("controller", list(_state_spans(run.controller_status, end))),
        Lane("device", list(_state_spans(run.device_status, end))),
    ]
    if len(run.holds):
        lanes.append(Lane("hold", list(_hold_spans(run, end))))
    stops = [
        Span(result.log_time, result.log_time, RED) for result in run.results if is_aborted(result)
    ]
    if stops:
        lanes.append(Lane("aborted steps", stops))
    tripped = [Span(event.log_time, event.log_time, MEASURED) for event in trips(run)]
    lanes.append(Lane("watchdogs", tripped))
    health = health_of(run)
    parts = dict.fromkeys(event.part for event in health)
    lanes += [
        Lane(part, list(_problem_spans(health, part, end))) for part in list(parts)[:_MAX_PARTS]
    ]
    return [lane for lane in lanes if lane.spans]


def event_figure(run: Run) -> Figure | None:
    """Draw the lanes over the wall time since the first command; None without lanes."""
    lanes = lanes_of(run)
    if not lanes:
        return None
    begin = run.first_command
    start = min(s.begin for lane in lanes for s in lane.spans) if begin is None else begin
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 1.5 + 0.3 * len(lanes)), layout="constrained")
        axes = figure.subplots()
        length = (_end(run) - min(s.begin for lane in lanes for s in lane.spans)) * 1e-9
        for row, lane in enumerate(lanes):
            for color in dict.fromkeys(span.color for span in lane.spans):
                bars = [
                    ((s.begin - start) * 1e-9, max((s.end - s.begin) * 1e-9, _MIN_LENGTH * length))
                    for s in lane.spans
                    if s.color == color
                ]
                axes.broken_barh(bars, (row - 0.36, 0.72), color=color, lw=0)
        axes.set_yticks(range(len(lanes)), [lane.name for lane in lanes])
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        axes.set_axisbelow(True)
        axes.set_xlabel("wall time since the first command [s]")
        _legend(figure, {span.color for lane in lanes for span in lane.spans})
        return figure


def level_name(level: int) -> str:
    """Return the name of a diagnostic level."""
    return _LEVEL_NAMES.get(level, "?")


def _state_spans(statuses: Sequence[Status], end: int) -> Iterable[Span]:
    """Yield a span for each period of a state."""
    changes = [(s.log_time, s.values.get("state", "")) for s in statuses]
    begin, state = changes[0] if changes else (0, "")
    for time, now in changes:
        if now != state:
            yield Span(begin, time, _STATE_COLORS.get(state, _QUIET))
            begin, state = time, now
    if changes:
        yield Span(begin, end, _STATE_COLORS.get(state, _QUIET))


def _hold_spans(run: Run, end: int) -> Iterable[Span]:
    times, pressed = run.holds.received.tolist(), run.holds.values[:, 0] > 0.5
    begin = None
    for time, now in zip(times, pressed.tolist(), strict=True):
        if now and begin is None:
            begin = time
        elif not now and begin is not None:
            yield Span(begin, time, GOAL_BAND)
            begin = None
    if begin is not None:
        yield Span(begin, end, GOAL_BAND)


def _problem_spans(health: Sequence[HealthEvent], part: str, end: int) -> Iterable[Span]:
    """Yield the periods in which a part had a problem."""
    events = [event for event in health if event.part == part]
    for event, after in zip(events, [*(e.log_time for e in events[1:]), end], strict=True):
        if event.level:
            yield Span(event.log_time, after, _LEVEL_COLORS.get(event.level, RED))


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
