"""The report of a run as one self-contained HTML page."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence

from needle_analysis.report import html_page
from needle_analysis.report.event_figure import level_name
from needle_analysis.report.step_figures import timing_rows
from needle_analysis.run.run_events import troubles
from needle_analysis.run.stage_timing import StageTiming
from needle_bags.reading.bag_reader import Run
from needle_common.commands.cli import JsonValue

_MOST_EVENTS = 60
CAPTIONS = {
    "states": (
        "State over insertion",
        "Orange circles: measured by the tracker. Black: the truth. Blue: the observer's estimate."
        " Steering works when the black line in the first row ends inside the green band.",
    ),
    "path": (
        "Path of the needle",
        "The side view's vertical axis is stretched; the view from above is to scale.",
    ),
    "errors": (
        "How good was the measurement, how good the estimate",
        "Both against the simulation's truth, at equal times of exposure.",
    ),
    "innovation": (
        "Innovation and gate",
        "How far each tip was from where estimate, joints and an arc of the configured curvature"
        " had it, and how near it came to being refused.",
    ),
    "images": (
        "What the cameras saw",
        "Cut out around the tip. Orange circle: the measured tip, projected back into the image;"
        " green cross: the truth.",
    ),
    "timing": (
        "Timing of each stage",
        "By when the messages were sent. In lock-step simulation the device's part is computing.",
    ),
    "events": (
        "States, hold and faults",
        "The same wall time for all rows. Only parts that were not well have a row of their own.",
    ),
}
_AFTER = ("timing", "events")
TILES = (
    ("r1 at the start", "r1_initial_mm", "{:+.2f}", "mm"),
    ("r1 at the end (true)", "r1_final_mm", "{:+.2f}", "mm"),
    ("Distance from the point at the end (true)", "point_error_mm", "{:.2f}", "mm"),
    ("r1 RMS, last 20 mm", "r1_rms_last_20_mm", "{:.2f}", "mm"),
    ("Tip error, 95 %", "tip_error_p95_mm", "{:.2f}", "mm"),
    ("Depth error, 95 %", "depth_error_p95_mm", "{:.2f}", "mm"),
    ("Steps", "steps", "{:d}", ""),
    ("Speed", "steps_per_s", "{:.1f}", "steps/s"),
    ("Rotation in all", "rotation_total_deg", "{:.0f}", "deg"),
    ("Exposures without a tip", "tips_missed", "{:d}", ""),
    ("Steps aborted", "steps_aborted", "{:d}", ""),
    ("Watchdog trips", "watchdog_trips", "{:d}", ""),
    ("Wall time", "wall_s", "{:.1f}", "s"),
)
"""Label, key, format and unit of the figures at the top."""
_SUMMARY_KEYS = ("level", "controller", "seed")


def build_page(
    run: Run,
    summary: Mapping[str, JsonValue],
    images: Mapping[str, bytes],
    timings: Sequence[StageTiming],
) -> str:
    """Return the page.

    Parameters
    ----------
    run : Run
        The recorded run.
    summary : mapping
        Its figures, from `run_summary.summarize`.
    images : mapping
        Figure name to PNG data; the names that have captions are shown, in their order.
    timings : sequence of StageTiming
        How long each stage took.

    Returns
    -------
    str
        HTML without references to other files.
    """
    return html_page.page(
        f"Needle steering run {run.path.absolute().name}",
        [
            _verdict(run, summary),
            _tiles(summary),
            *(_figure(name, images) for name in CAPTIONS if name not in _AFTER),
            _figure("timing", images),
            _timing(timings),
            _figure("events", images),
            _health(run),
            _provenance(run, summary),
        ],
    )


def verdict_text(summary: Mapping[str, JsonValue]) -> tuple[str, str]:
    """Return the result in a few words, and the sentence that explains it."""
    if summary["rerun_of"] is not None:
        by = summary["steered_by"] or "another controller"
        return "Rerun", (
            f"Nothing was steered here: joints and truth are those of {summary['rerun_of']}, which "
            f"{by} steered. Estimates and commands are what {summary['controller'] or 'it'} would "
            "have said there."
        )
    final = summary["r1_final_mm"]
    depth = html_page.number(summary["insertion_final_mm"], "{:.0f} mm")
    if final is None:
        return "No ground truth", (
            f"The bag has no sim/tip_pose, so it cannot tell how far the tip is from the plane. "
            f"Inserted {depth}."
        )
    target, distance = "plane", html_page.number(final, "{:+.2f} mm")
    if summary["point_error_mm"] is not None:
        target, distance = "point", html_page.number(summary["point_error_mm"], "{:.2f} mm")
    distance = f"The tip ended {distance} from the wanted {target}"
    if summary["converged"]:
        return "Converged", f"{distance} (goal: within ±1 mm), {depth} deep."
    if not summary["reached_depth"]:
        reason = summary["reason"] or f"state {summary['state'] or 'unknown'}"
        return "Not finished", f"{distance}, but stopped at {depth}: {reason}."
    return f"Missed the {target}", f"{distance} (goal: within ±1 mm), {depth} deep."


def _verdict(run: Run, summary: Mapping[str, JsonValue]) -> str:
    words, sentence = verdict_text(summary)
    about = [run.path.absolute().name]
    about += [f"{key} {summary[key]}" for key in _SUMMARY_KEYS if summary[key] is not None]
    good = summary["converged"] is True and summary["rerun_of"] is None
    return html_page.banner(words, sentence, " · ".join(about), good=good)


def _tiles(summary: Mapping[str, JsonValue]) -> str:
    return html_page.tiles(
        (label, html_page.number(summary[key], form), unit)
        for label, key, form, unit in TILES
        if summary[key] is not None
    )


def _figure(name: str, images: Mapping[str, bytes]) -> str:
    return html_page.figure(*CAPTIONS[name], images[name]) if name in images else ""


def _timing(timings: Sequence[StageTiming]) -> str:
    if not timings:
        return ""
    parts = ("median", "95 %", "99 %", "largest")
    head = ("stage", "from what to what", "steps", *(f"{part} [ms]" for part in parts))
    return html_page.table(head, timing_rows(timings))


def _health(run: Run) -> str:
    title = "<h2>Warnings and faults</h2>"
    events = troubles(run)
    if not events:
        return title + html_page.note("None were reported.")
    start = run.first_command or events[0].log_time
    rows = [
        (
            f"{(event.log_time - start) * 1e-9:+.1f} s",
            level_name(event.level),
            event.part,
            event.message,
        )
        for event in events
    ]
    shown = html_page.table(("when", "what", "where", "why"), rows[:_MOST_EVENTS])
    more = len(rows) - _MOST_EVENTS
    rest = html_page.note(f"{more} more are in the bag, on /diagnostics.") if more > 0 else ""
    words = (
        "Seconds of wall time after the first step's command. What was over before it, while nodes "
        "waited for each other, is left out."
    )
    return title + html_page.note(words) + shown + rest


def _provenance(run: Run, summary: Mapping[str, JsonValue]) -> str:
    versions = {"commit": run.commit or "unknown", **run.versions}
    parts = ["<h2>What was run</h2>"]
    if run.run_info:
        parts.append(html_page.pairs(run.run_info))
    if run.recording:
        parts.append("<h2>The recording</h2>" + html_page.pairs(run.recording))
    parts.append(html_page.details("All figures (summary.json)", html_page.pairs(summary)))
    for node, values in sorted(run.parameters.items()):
        parts.append(html_page.details(f"Parameters of {node}", html_page.pairs(values)))
    if run.calibration:
        text = f"<pre>{html.escape(run.calibration)}</pre>"
        parts.append(html_page.details("Calibration", text))
    parts.append(html_page.details("Recorded topics", html_page.pairs(run.topics)))
    parts.append(html_page.details("Versions", html_page.pairs(versions), opened=True))
    return "\n".join(parts)
