"""The report of a run as one self-contained HTML page."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping
from typing import Any

from needle_bringup.bag_reader import Run
from needle_common.cli import JsonValue

_CSS = """
:root { --ink: #16191d; --soft: #5c646e; --line: #dfe3e8; --good: #1d7f42; --bad: #b3261e; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 60rem; padding: 1rem; color: var(--ink); background: #fff;
  font: 16px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
header { border-radius: .6rem; padding: 1.1rem 1.3rem; color: #fff; background: var(--bad);
  print-color-adjust: exact; -webkit-print-color-adjust: exact; }
header.good { background: var(--good); }
header h1 { margin: 0; font-size: 1.9rem; line-height: 1.15; }
header p { margin: .45rem 0 0; font-size: 1.05rem; }
header small { opacity: .88; }
.tiles { display: grid; gap: .6rem; margin: .9rem 0 0; padding: 0;
  grid-template-columns: repeat(auto-fit, minmax(9.2rem, 1fr)); }
.tiles div { border: 1px solid var(--line); border-radius: .5rem; padding: .55rem .75rem; }
.tiles dt { color: var(--soft); font-size: .8rem; line-height: 1.25; }
.tiles dd { margin: .1rem 0 0; font-size: 1.35rem; font-weight: 650;
  font-variant-numeric: tabular-nums; }
.tiles dd span { font-size: .85rem; font-weight: 400; color: var(--soft); }
h2 { font-size: 1.2rem; margin: 1.8rem 0 .3rem; }
figure { margin: 0; break-inside: avoid; }
figcaption, .note { color: var(--soft); font-size: .9rem; margin: 0 0 .4rem; }
img { display: block; width: 100%; max-width: 50rem; height: auto; margin: 0 auto; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .88rem; }
td, th { text-align: left; vertical-align: top; padding: .22rem .6rem .22rem 0;
  border-bottom: 1px solid var(--line); overflow-wrap: anywhere; }
th { color: var(--soft); font-weight: 500; white-space: nowrap; width: 15rem; }
.events th { width: auto; }
details { margin: .35rem 0; } summary { cursor: pointer; font-weight: 600; }
pre { overflow-x: auto; font-size: .8rem; background: #f5f6f8; padding: .7rem;
  border-radius: .4rem; white-space: pre-wrap; }
@media (max-width: 34rem) { body { padding: .6rem; } header h1 { font-size: 1.5rem; }
  .tiles { grid-template-columns: 1fr 1fr; } }
@media print { body { max-width: none; padding: 0; font-size: 10.5pt; } details { display: block; }
  h2 { break-after: avoid; } .tiles { grid-template-columns: repeat(4, 1fr); } }
"""

_CAPTIONS = {
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
    "images": (
        "What the cameras saw",
        "Cut out around the tip. Orange circle: the measured tip, projected back into the image;"
        " green cross: the truth.",
    ),
}


def build_page(run: Run, summary: Mapping[str, JsonValue], images: Mapping[str, bytes]) -> str:
    """Return the page.

    Parameters
    ----------
    run : Run
        The recorded run.
    summary : mapping
        Its figures, from `run_summary.summarize`.
    images : mapping
        Figure name to PNG data; the names that have captions are shown, in their order.

    Returns
    -------
    str
        HTML without references to other files.
    """
    title = f"Needle steering run {run.path.absolute().name}"
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{html.escape(title)}</title><style>{_CSS}</style></head><body>",
        _verdict(run, summary),
        _tiles(summary),
        *(_figure(name, images[name]) for name in _CAPTIONS if name in images),
        _health(run),
        _provenance(run, summary),
        "</body></html>",
    ]
    return "\n".join(part for part in parts if part)


def verdict_text(summary: Mapping[str, JsonValue]) -> tuple[str, str]:
    """Return the result in a few words, and the sentence that explains it."""
    final = summary["r1_final_mm"]
    depth = _number(summary["insertion_final_mm"], "{:.0f} mm")
    if final is None:
        return "No ground truth", (
            f"The bag has no sim/tip_pose, so it cannot tell how far the tip is from the plane. "
            f"Inserted {depth}."
        )
    distance = f"The tip ended {_number(final, '{:+.2f} mm')} from the wanted plane"
    if summary["converged"]:
        return "Converged", f"{distance} (goal: within ±1 mm), {depth} deep."
    if not summary["reached_depth"]:
        reason = summary["reason"] or f"state {summary['state'] or 'unknown'}"
        return "Not finished", f"{distance}, but stopped at {depth}: {reason}."
    return "Missed the plane", f"{distance} (goal: within ±1 mm), {depth} deep."


def _verdict(run: Run, summary: Mapping[str, JsonValue]) -> str:
    words, sentence = verdict_text(summary)
    about = ", ".join(
        f"{label} {summary[key]}"
        for key, label in (("level", "level"), ("controller", "controller"), ("seed", "seed"))
        if summary[key] is not None
    )
    kind = ' class="good"' if summary["converged"] else ""
    name = html.escape(run.path.absolute().name)
    return (
        f"<header{kind}><h1>{html.escape(words)}</h1><p>{html.escape(sentence)}</p>"
        f"<p><small>{name}{' · ' if about else ''}{html.escape(about)}</small></p></header>"
    )


def _tiles(summary: Mapping[str, JsonValue]) -> str:
    tiles = (
        ("r1 at the start", "r1_initial_mm", "{:+.2f}", "mm"),
        ("r1 at the end (true)", "r1_final_mm", "{:+.2f}", "mm"),
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
    shown = [
        f"<div><dt>{label}</dt><dd>{_number(summary[key], form)} <span>{unit}</span></dd></div>"
        for label, key, form, unit in tiles
        if summary[key] is not None
    ]
    return f'<dl class="tiles">{"".join(shown)}</dl>'


def _figure(name: str, data: bytes) -> str:
    title, caption = _CAPTIONS[name]
    source = base64.b64encode(data).decode("ascii")
    return (
        f"<h2>{title}</h2><figure><figcaption>{caption}</figcaption>"
        f'<img alt="{title}" src="data:image/png;base64,{source}"></figure>'
    )


def _health(run: Run) -> str:
    events = [event for event in run.health if event.level]
    if not events:
        return "<h2>Warnings and faults</h2><p class=note>None were reported.</p>"
    start = run.first_command or events[0].log_time
    level_names = {1: "warning", 2: "ERROR", 3: "stale"}
    rows = [
        ((event.log_time - start) * 1e-9, level_names.get(event.level, "?"), event)
        for event in events
    ]
    lines = "".join(
        f"<tr><th>{seconds:+.1f} s</th><td>{level}</td><td>{html.escape(event.part)}</td>"
        f"<td>{html.escape(event.message)}</td></tr>"
        for seconds, level, event in rows
    )
    return (
        "<h2>Warnings and faults</h2><p class=note>Seconds of wall time after the first step's "
        f"command.</p><div class=scroll><table class=events>{lines}</table></div>"
    )


def _provenance(run: Run, summary: Mapping[str, JsonValue]) -> str:
    versions = {"commit": run.commit or "unknown", **run.versions}
    parts = ["<h2>What was run</h2>"]
    if run.run_info:
        parts.append(_table(run.run_info))
    parts.append(_details("All figures (summary.json)", _table(summary)))
    for node, values in sorted(run.parameters.items()):
        parts.append(_details(f"Parameters of {html.escape(node)}", _table(values)))
    if run.calibration:
        text = f"<pre>{html.escape(run.calibration)}</pre>"
        parts.append(_details("Calibration", text))
    parts.append(_details("Recorded topics", _table(run.topics)))
    parts.append(_details("Versions", _table(versions), opened=True))
    return "\n".join(parts)


def _details(title: str, content: str, *, opened: bool = False) -> str:
    return f"<details{' open' if opened else ''}><summary>{title}</summary>{content}</details>"


def _table(values: Mapping[str, Any]) -> str:
    rows = "".join(
        f"<tr><th>{html.escape(str(key))}</th><td>{html.escape(_shown(value))}</td></tr>"
        for key, value in values.items()
    )
    return f"<div class=scroll><table>{rows}</table></div>"


def _shown(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _number(value: JsonValue, form: str) -> str:
    return form.format(value) if isinstance(value, (int, float)) else "-"
