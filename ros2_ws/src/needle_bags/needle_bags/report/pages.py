"""Report of a run, and comparison of two runs, as self-contained HTML pages.

The templates are in `static/`.
"""

from __future__ import annotations

import base64
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from needle_bags.figures.event_figure import level_name
from needle_bags.figures.figure_style import png_size
from needle_bags.figures.film import READINGS, Frame, View
from needle_bags.figures.run_figures import is_same_needle
from needle_bags.figures.timing_figure import timing_rows
from needle_bags.reading.bag_reader import Run
from needle_bags.run.run_summary import rerun_of, troubles
from needle_bags.run.stage_timing import StageTiming
from needle_core.commands.cli import JsonValue

Summary = Mapping[str, JsonValue]

_STATIC = Path(__file__).with_name("static")
_FRAMES_PER_SECOND = 8
TILES = (
    ("r1 at the start", "r1_initial_mm", "{:+.2f}", "mm"),
    ("r1 at the end (true)", "r1_final_mm", "{:+.2f}", "mm"),
    ("Distance from the point at the end (true)", "point_error_mm", "{:.2f}", "mm"),
    ("r1 RMS, last 20 mm", "r1_rms_last_20_mm", "{:.2f}", "mm"),
    ("Tip error, 95 %", "tip_error_p95_mm", "{:.2f}", "mm"),
    ("Depth error, 95 %", "depth_error_p95_mm", "{:.2f}", "mm"),
    ("Steps", "steps", "{:d}", ""),
    ("Speed", "steps_per_s", "{:.1f}", "steps/s"),
    ("Total rotation", "rotation_total_deg", "{:.0f}", "deg"),
    ("Exposures without a tip", "tips_missed", "{:d}", ""),
    ("Steps aborted", "steps_aborted", "{:d}", ""),
    ("Watchdog trips", "watchdog_trips", "{:d}", ""),
    ("Wall time", "wall_s", "{:.1f}", "s"),
)
"""Label, key, format and unit of the figures on the page."""


def build_page(
    run: Run,
    summary: Summary,
    images: Mapping[str, bytes],
    timings: Sequence[StageTiming],
    film: tuple[Sequence[Frame], Sequence[View]],
) -> str:
    """Return the page about a run.

    Parameters
    ----------
    run : Run
        The recorded run.
    summary : mapping
        Its figures, from `run_summary.summarize`.
    images : mapping
        PNG data by figure name.
    timings : sequence of StageTiming
        Duration of each stage.
    film : pair
        Frames and views of the film.

    Returns
    -------
    str
        HTML without references to other files.
    """
    frames, views = film
    return _render(
        "run.html",
        run=run,
        name=run.path.absolute().name,
        bag=shlex.quote(str(run.path)),
        summary=summary,
        verdict=verdict_text(summary),
        good=summary["converged"] is True and summary["rerun_of"] is None,
        rerun_of=rerun_of(run),
        tiles=TILES,
        images=images,
        timings=timing_rows(timings),
        events=_events(run),
        readings=READINGS,
        frames=frames,
        views=views,
        film=_film_data(frames, views),
    )


def verdict_text(summary: Mapping[str, JsonValue]) -> tuple[str, str]:
    """Return the result in a few words, and a sentence with details."""
    if summary["rerun_of"] is not None:
        by = summary["steered_by"] or "another controller"
        return "Rerun", (
            f"This is a rerun: joints and truth come from {summary['rerun_of']}, "
            f"steered by {by}. Estimates and commands are those that "
            f"{summary['controller'] or 'it'} would have sent."
        )
    final = summary["r1_final_mm"]
    depth = _number(summary["insertion_final_mm"], "{:.0f} mm")
    if final is None:
        return "No ground truth", (
            "The bag has no sim/tip_pose, so the distance of the tip from the plane is unknown. "
            f"Inserted {depth}."
        )
    target, distance = "plane", _number(final, "{:+.2f} mm")
    if summary["point_error_mm"] is not None:
        target, distance = "point", _number(summary["point_error_mm"], "{:.2f} mm")
    distance = f"The tip ended {distance} from the {target}"
    if summary["converged"]:
        return "Converged", f"{distance} (goal: within ±1 mm), {depth} deep."
    if not summary["reached_depth"]:
        reason = summary["reason"] or f"state {summary['state'] or 'unknown'}"
        return "Not finished", f"{distance}, but stopped at {depth}: {reason}."
    return f"Missed the {target}", f"{distance} (goal: within ±1 mm), {depth} deep."


def _events(run: Run) -> list[tuple[str, str, str, str]]:
    """Return (time, level, part, message) of all warnings and faults."""
    events = troubles(run)
    start = run.first_command or (events[0].log_time if events else 0)
    return [
        (
            f"{(event.log_time - start) * 1e-9:+.1f} s",
            level_name(event.level),
            event.part,
            event.message,
        )
        for event in events
    ]


def _film_data(frames: Sequence[Frame], views: Sequence[View]) -> dict[str, Any]:
    """Return the data of the film for `static/film.js`."""
    return {
        "rate": _FRAMES_PER_SECOND,
        "readings": [frame.readings for frame in frames],
        "views": [
            {
                "pictures": None if view.is_chart else [_base64(one) for one in view.pictures],
                "lines": [_points(line) for line in view.lines],
            }
            for view in views
        ],
    }


def _points(line: np.ndarray[Any, Any]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in line.tolist())


def build_pair_page(
    runs: tuple[Run, Run], summaries: tuple[Summary, Summary], images: Mapping[str, bytes]
) -> str:
    """Return the page that compares two runs.

    Parameters
    ----------
    runs, summaries : pairs
        A and B: the runs and their figures, from `run_summary.summarize`.
    images : mapping
        PNG data by figure name.

    Returns
    -------
    str
        HTML without references to other files.
    """
    steered = [summary for summary in summaries if summary["rerun_of"] is None]
    return _render(
        "pair.html",
        names=[run.path.absolute().name for run in runs],
        runs=runs,
        # The recorder's parameters contain the name of the bag, which always differs.
        nodes=sorted(
            node
            for node in runs[0].parameters.keys() | runs[1].parameters.keys()
            if not node.endswith("/recorder")
        ),
        versions=[
            {"commit": run.commit[:12] + run.commit[40:] or "unknown", **run.versions}
            for run in runs
        ],
        verdicts=[verdict_text(summary) for summary in summaries],
        good=bool(steered) and all(summary["converged"] is True for summary in steered),
        same_needle=is_same_needle(runs),
        figures=list(_figures(*summaries)),
        images=images,
    )


def pair_values(summaries: tuple[Summary, Summary]) -> dict[str, JsonValue]:
    """Return the figures of both runs and their differences as one flat mapping, for --json."""
    values: dict[str, JsonValue] = {}
    for key in summaries[0]:
        a, b = summaries[0][key], summaries[1][key]
        values[f"a_{key}"], values[f"b_{key}"] = a, b
        difference = _difference(a, b)
        if difference is not None:
            values[f"difference_{key}"] = difference
    return values


def _figures(first: Summary, second: Summary) -> Iterator[tuple[str, str, str, str]]:
    """Yield (label, A, B, B - A) of the figures that either run has."""
    for label, key, form, unit in TILES:
        a, b = first[key], second[key]
        if a is None and b is None:
            continue
        signed = form.replace("{:", "{:+").replace("++", "+")
        name = f"{label} [{unit}]" if unit else label
        yield name, _number(a, form), _number(b, form), _number(_difference(a, b), signed)


def _difference(a: JsonValue, b: JsonValue) -> float | None:
    """Return b - a, or None unless both are numbers."""
    if isinstance(a, bool) or isinstance(b, bool):
        return None
    if not isinstance(a, (int, float)) or not isinstance(b, (int, float)):
        return None
    return b - a


def _text(value: Any) -> str:
    """Format a value as text, floats with six digits."""
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _number(value: JsonValue, form: str) -> str:
    """Return a formatted number, or a dash for a missing value."""
    return form.format(value) if isinstance(value, (int, float)) else "-"


def _base64(data: bytes) -> str:
    """Return data in base64, for a `data:` URL."""
    return base64.b64encode(data).decode("ascii")


def _anchor(title: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_STATIC),
        autoescape=True,
        trim_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters.update(anchor=_anchor, base64=_base64, text=_text, number=_number)
    environment.globals.update(
        png_size=png_size,
        report_css=Markup((_STATIC / "report.css").read_text("utf-8")),
        film_js=Markup((_STATIC / "film.js").read_text("utf-8")),
    )
    return environment


_ENVIRONMENT = _environment()


def _render(template: str, **values: Any) -> str:
    """Return the HTML of a template in `static/`; it refers to no other file."""
    return _ENVIRONMENT.get_template(template).render(values)
