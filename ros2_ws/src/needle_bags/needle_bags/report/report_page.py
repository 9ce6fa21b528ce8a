"""The report of a run as one HTML page (`static/run.html`)."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from needle_bags.figures.event_figure import level_name
from needle_bags.figures.film import READINGS, Frame
from needle_bags.figures.film_views import View
from needle_bags.figures.step_figures import timing_rows
from needle_bags.reading.bag_reader import Run
from needle_bags.report.page import base64_text, number, render
from needle_bags.run.run_summary import rerun_of, troubles
from needle_bags.run.stage_timing import StageTiming
from needle_core.commands.cli import JsonValue

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
"""Label, key, format and unit of the run's figures."""


def build_page(
    run: Run,
    summary: Mapping[str, JsonValue],
    images: Mapping[str, bytes],
    timings: Sequence[StageTiming],
    film: tuple[Sequence[Frame], Sequence[View]],
) -> str:
    """Return the page.

    Parameters
    ----------
    run : Run
        The recorded run.
    summary : mapping
        Its figures, from `run_summary.summarize`.
    images : mapping
        Figure name to PNG data.
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
    return render(
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
    depth = number(summary["insertion_final_mm"], "{:.0f} mm")
    if final is None:
        return "No ground truth", (
            "The bag has no sim/tip_pose, so the distance of the tip from the plane is unknown. "
            f"Inserted {depth}."
        )
    target, distance = "plane", number(final, "{:+.2f} mm")
    if summary["point_error_mm"] is not None:
        target, distance = "point", number(summary["point_error_mm"], "{:.2f} mm")
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
                "pictures": None if view.is_chart else [base64_text(one) for one in view.pictures],
                "lines": [_points(line) for line in view.lines],
            }
            for view in views
        ],
    }


def _points(line: np.ndarray[Any, Any]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in line.tolist())
