"""The report of a run as one self-contained HTML page."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence

from markupsafe import Markup

from needle_bags.figures.event_figure import level_name
from needle_bags.figures.film import Frame
from needle_bags.figures.film_views import View
from needle_bags.figures.step_figures import timing_rows
from needle_bags.reading.bag_reader import Run
from needle_bags.report.film_page import film_html
from needle_bags.report.glossary import Glossary
from needle_bags.report.html_page import Section, number, page, parts
from needle_bags.run.run_events import troubles
from needle_bags.run.run_summary import rerun_of
from needle_bags.run.stage_timing import StageTiming
from needle_core.commands.cli import JsonValue

_MOST_EVENTS = 60
_NOTHING = Markup("")
CAPTIONS = {
    "states": (
        "State over insertion",
        "Orange circles: [measured] by the tracker. Broad grey line: the [truth]. Thin blue line: "
        "the controller's [estimate]. Steering works when the grey line of [r1] ends inside the "
        "green band. To get there it changes the [pitch], by choosing the [roll] of the [bevel].",
    ),
    "path": (
        "Path of the needle",
        "The side view's vertical axis is stretched; the view from above is to scale.",
    ),
    "errors": (
        "How good was the measurement, how good the estimate",
        "Both against the simulation's [truth], at equal times of [exposure].",
    ),
    "innovation": (
        "Innovation and gate",
        "The [innovation] is how far each tip was from where estimate, joints and an arc of the "
        "configured curvature had it; it should stay within 2 [sigma]. The [gate] shows how near "
        "each tip came to being refused.",
    ),
    "images": (
        "What the cameras saw",
        "Cut out around the tip. Orange circle: the [measured] tip, projected back into the image; "
        "blue cross: the [truth].",
    ),
    "timing": (
        "Timing of each stage",
        "By when the messages were sent.",
    ),
    "events": (
        "States, hold and faults",
        "The same wall time for all rows. The needle moves with the [hold] alone. Only parts that "
        "were not well have a row of their own.",
    ),
}
_AFTER = ("timing", "events")
FILM = (
    "Film of the insertion",
    "Blue: the needle; orange: its tip. {over}The dotted line is the whole way of the tip; "
    "vertical axes are stretched. {count} of the bag's [exposures|exposure], equally far apart by "
    "how far the needle was moved. What the controller believes is [doubtful] or trusted; ± is the "
    "interval that holds [r1] with 95 %. The [pitch] and the [roll] are the tip's.",
)
_TRUE = "Both are the [truth]. "
_MEASURED = "Both as [measured]. "
_BOTH = (
    "In the cameras' pictures as [measured]: where its tip was seen on its way in; in the drawings "
    "the [truth], where the bag has it. "
)
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
"""Label, key, format and unit of the run's figures."""
TILE_NOTE = (
    "[r1], its [RMS], and errors of [95 %] of the tips: measured beside the [truth]. A [step] that "
    "was aborted, or a [watchdog] that tripped, is told below."
)
_SUMMARY_KEYS = ("level", "controller", "seed")


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
        Figure name to PNG data; the names that have captions are shown, in their order.
    timings : sequence of StageTiming
        How long each stage took.
    film : pair
        Its frames, and what is shown of them.

    Returns
    -------
    str
        HTML without references to other files.
    """
    glossary = Glossary()

    def shown(name: str) -> Markup:
        text = CAPTIONS[name][1]
        picture = images.get(name)
        if picture is None:
            return _NOTHING
        kind = "photo" if name == "images" else "chart"
        return glossary.explain(text) + parts.figure(CAPTIONS[name][0], picture, kind)

    def section(name: str, more: Markup = _NOTHING) -> Section:
        return Section(CAPTIONS[name][0], shown(name) + more)

    return page(
        f"Needle steering run {run.path.absolute().name}",
        _verdict(run, summary),
        [
            Section(FILM[0], _film(run, film, glossary)),
            Section("The run in figures", _tiles(summary, glossary)),
            *(section(name) for name in CAPTIONS if name not in _AFTER),
            section("timing", _timing(timings)),
            section("events"),
            Section("Warnings and faults", _health(run, glossary)),
            Section("Repeat it", _repeat(run)),
            Section("What was run", _provenance(run, summary)),
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
    depth = number(summary["insertion_final_mm"], "{:.0f} mm")
    if final is None:
        return "No ground truth", (
            f"The bag has no sim/tip_pose, so it cannot tell how far the tip is from the plane. "
            f"Inserted {depth}."
        )
    target, distance = "plane", number(final, "{:+.2f} mm")
    if summary["point_error_mm"] is not None:
        target, distance = "point", number(summary["point_error_mm"], "{:.2f} mm")
    distance = f"The tip ended {distance} from the wanted {target}"
    if summary["converged"]:
        return "Converged", f"{distance} (goal: within ±1 mm), {depth} deep."
    if not summary["reached_depth"]:
        reason = summary["reason"] or f"state {summary['state'] or 'unknown'}"
        return "Not finished", f"{distance}, but stopped at {depth}: {reason}."
    return f"Missed the {target}", f"{distance} (goal: within ±1 mm), {depth} deep."


def _verdict(run: Run, summary: Mapping[str, JsonValue]) -> Markup:
    words, sentence = verdict_text(summary)
    about = [run.path.absolute().name]
    about += [f"{key} {summary[key]}" for key in _SUMMARY_KEYS if summary[key] is not None]
    good = summary["converged"] is True and summary["rerun_of"] is None
    return parts.banner(words, sentence, " · ".join(about), good=good)


def _tiles(summary: Mapping[str, JsonValue], glossary: Glossary) -> Markup:
    """Return the figures, and what their words mean."""
    known = [tile for tile in TILES if summary[tile[1]] is not None]
    boxes = parts.tiles(
        (label, number(summary[key], form), unit) for label, key, form, unit in known
    )
    return boxes + glossary.explain(TILE_NOTE)


def _film(run: Run, film: tuple[Sequence[Frame], Sequence[View]], glossary: Glossary) -> Markup:
    frames, views = film
    if not frames:
        return _NOTHING
    alone = _TRUE if len(run.truth) else _MEASURED
    over = alone if all(view.is_chart for view in views) else _BOTH
    text = FILM[1].format(over=over, count=len(frames))
    return film_html(frames, views) + glossary.explain(text)


def _timing(timings: Sequence[StageTiming]) -> Markup:
    if not timings:
        return _NOTHING
    quantiles = ("median", "95 %", "99 %", "largest")
    head = ("stage", "from what to what", "steps", *(f"{part} [ms]" for part in quantiles))
    return parts.table(head, timing_rows(timings))


def _health(run: Run, glossary: Glossary) -> Markup:
    events = troubles(run)
    if not events:
        return parts.note("None were reported.")
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
    shown = parts.table(("when", "what", "where", "why"), rows[:_MOST_EVENTS])
    more = len(rows) - _MOST_EVENTS
    rest = parts.note(f"{more} more are in the bag, on /diagnostics.") if more > 0 else _NOTHING
    words = (
        "Seconds of wall time after the first [step]'s command. What was over before it, while "
        "nodes waited for each other, is left out."
    )
    return glossary.explain(words) + shown + rest


def _repeat(run: Run) -> Markup:
    """Return the command that made the bag, where it tells, and those that read it."""
    command = run.run_info.get("command")
    if isinstance(command, str):
        commit = f", of commit {run.commit[:12]}" if run.commit else ""
        told = parts.note(f"The run, with the sources it was made with{commit}:")
        told += parts.code(command)
    elif rerun_of(run) is not None:
        told = parts.note(f"A rerun of {rerun_of(run)}.")
    else:
        told = parts.note("The bag does not say which command it was recorded by.")
    bag = shlex.quote(str(run.path))
    words = "What was recorded, through today's code; and this page:"
    again = f"ros2 run needle_bags rerun {bag}\nros2 run needle_bags report {bag}"
    return told + parts.note(words) + parts.code(again)


def _provenance(run: Run, summary: Mapping[str, JsonValue]) -> Markup:
    versions = {"commit": run.commit or "unknown", **run.versions}
    info = {key: value for key, value in run.run_info.items() if key != "command"}
    shown = [parts.details("Told to the recorder", parts.pairs(info))] if info else []
    if run.recording:
        shown.append(parts.note("The recording:") + parts.pairs(run.recording))
    shown.append(parts.details("All figures (summary.json)", parts.pairs(summary)))
    for node, values in sorted(run.parameters.items()):
        shown.append(parts.details(f"Parameters of {node}", parts.pairs(values)))
    if run.calibration:
        shown.append(parts.details("Calibration", parts.code(run.calibration)))
    shown.append(parts.details("Recorded topics", parts.pairs(run.topics)))
    shown.append(parts.details("Versions", parts.pairs(versions), opened=True))
    return Markup("\n").join(shown)
