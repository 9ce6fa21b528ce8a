"""Result of a rerun as text and as flat JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from needle_bags.reading.bag_reader import Run
from needle_bags.rerun.bag_pass import Errors
from needle_bags.rerun.comparison import FIELDS, Comparison, FieldResult, TopicResult
from needle_bags.rerun.stages import Output
from needle_core.commands.cli import JsonValue

_SHOWN = 3
_DEGREES = 180.0 / math.pi


def tolerance_table() -> str:
    """Return the tolerances with their reasons, a line for each kind."""
    kinds = {field.tolerance: None for fields in FIELDS.values() for field in fields}
    rows = [(kind.unit, f"{kind.absolute:g}", f"{kind.relative:g}", kind.reason) for kind in kinds]
    return _table(("unit", "absolute", "relative", "reason"), rows, "<>><")


def describe(run: Run, comparison: Comparison) -> str:
    """Return a line for each differing field.

    Parameters
    ----------
    run : Run
        The run, for the insertion depths.
    comparison : Comparison
        The comparison.
    """
    lines = [_missing(run, topic) for topic in comparison.topics]
    rows = [
        (
            f"{field.topic} {field.field}",
            str(field.compared),
            str(field.differing),
            _largest_text(field),
            _depth_text(run, field.first),
        )
        for field in comparison.fields
        if field.differing
    ]
    if rows:
        titles = ("field", "compared", "differ", "largest", "first where")
        lines.append(_table(titles, rows, "<>>><"))
    return "\n".join(line for line in lines if line)


def outputs_table(run: Run, outputs: Sequence[Output]) -> str:
    """Return rounded outputs as a table with a line for each exposure.

    Parameters
    ----------
    run : Run
        The run.
    outputs : sequence of Output
        Outputs of the current code.
    """
    found = {(output.topic, output.stamp): output.message for output in outputs}
    stamps = np.array(sorted({output.stamp for output in outputs}), np.int64)
    rows = []
    for stamp, depth in zip(stamps.tolist(), run.insertion_at(stamps) * 1e3, strict=True):
        tip = found.get(("needle/tip", stamp))
        state = found.get(("needle/reduced_state", stamp))
        control = found.get(("needle/control_input", stamp))
        step = found.get(("device/joint_trajectory", stamp))
        rows.append(
            (
                f"{depth:.2f}",
                *_cells(tip and (tip.point.x, tip.point.y, tip.point.z), (1e3,) * 3, 4),
                *_cells(
                    state and (state.vector.x, state.vector.y, state.vector.z),
                    (1e3, _DEGREES, _DEGREES),
                    4,
                ),
                *_cells(control and (control.vector.y,), (1.0,), 2),
                *_cells(step and (step.points[0].positions[1],), (_DEGREES,), 3),
            )
        )
    head = (
        *("insertion_mm", "tip_x_mm", "tip_y_mm", "tip_z_mm", "r1_mm", "r2_deg", "r3_deg"),
        *("u_rad_per_m", "rotation_deg"),
    )
    return _table(head, rows, ">" * len(head)) + "\n"


def _cells(values: Sequence[float] | None, scales: Sequence[float], digits: int) -> list[str]:
    """Format scaled numbers as text; return dashes if there are none."""
    if values is None:
        return ["-"] * len(scales)
    # Adding 0 turns a rounded -0 into 0.
    return [
        f"{round(value * scale, digits) + 0.0:.{digits}f}"
        for value, scale in zip(values, scales, strict=True)
    ]


def errors_text(errors: Mapping[str, Errors]) -> str:
    """Return the errors of both estimates (`estimate_errors`) as a table; empty without truth."""
    rows = []
    for name, rms in errors.items():
        if rms is not None:
            r1, r2, r3 = rms[0] * 1e3, *np.degrees(rms[1:])
            rows.append((name, f"{r1:.3f} mm", f"{r2:.2f} deg", f"{r3:.2f} deg"))
    if not rows:
        return ""
    return _table(("estimate minus truth, rms", "r1", "r2", "r3"), rows, "<>>>")


def flat(run: Run, comparison: Comparison, errors: Mapping[str, Errors]) -> dict[str, JsonValue]:
    """Return the result as a flat mapping for --json."""
    values: dict[str, JsonValue] = {"bag": str(run.path), "changed": comparison.changed}
    for topic in comparison.topics:
        key = topic.topic.replace("/", "_")
        values[f"{key}_messages"] = topic.recorded
        values[f"{key}_missing"] = len(topic.missing)
        values[f"{key}_extra"] = len(topic.extra)
    for field in comparison.fields:
        key = f"{field.topic}_{field.field}".replace("/", "_").replace(" ", "_")
        values[f"{key}_differing"] = field.differing
        if field.unit:
            values[f"{key}_largest_difference{_SUFFIX[field.unit]}"] = field.largest
    for side, rms in errors.items():
        for i, (name, scale) in enumerate(_ERRORS):
            values[f"{side}_{name}"] = None if rms is None else float(rms[i] * scale)
    return values


_ERRORS = (
    ("r1_error_rms_mm", 1e3),
    ("r2_error_rms_deg", _DEGREES),
    ("r3_error_rms_deg", _DEGREES),
)
_SUFFIX: Mapping[str, str] = {
    "-": "",
    "m": "_m",
    "rad": "_rad",
    "1/m": "_per_m",
    "rad/m": "_rad_per_m",
    "1/m^2": "_per_m2",
    "s": "_s",
    "of sigmas": "_sigmas",
}


def _missing(run: Run, topic: TopicResult) -> str:
    parts = []
    for stamps, words in ((topic.missing, "recorded only"), (topic.extra, "only today")):
        if stamps:
            depths = ", ".join(_depth_text(run, stamp) for stamp in stamps[:_SHOWN])
            more = ", ..." if len(stamps) > _SHOWN else ""
            parts.append(f"  {topic.topic}: {len(stamps)} {words} (at {depths}{more})")
    return "\n".join(parts)


def _largest_text(field: FieldResult) -> str:
    if math.isinf(field.largest):
        return "not comparable" if field.unit else "not equal"
    unit = "" if field.unit in {"", "-"} else f" {field.unit}"
    return f"{field.largest:.3g}{unit}"


def _depth_text(run: Run, stamp: int | None) -> str:
    """Return the insertion depth at a stamp, or the time if the depth is unknown."""
    if stamp is None:
        return ""
    depth = float(run.insertion_at(np.array([stamp], np.int64))[0]) * 1e3
    return f"{depth:.1f} mm" if math.isfinite(depth) else f"{stamp * 1e-9:.3f} s"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], sides: str) -> str:
    """Return rows under a header, with columns aligned left (<) or right (>)."""
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    lines = []
    for row in (head, *rows):
        cells = zip(row, sides, widths, strict=True)
        lines.append("  " + "  ".join(f"{cell:{side}{width}}" for cell, side, width in cells))
    return "\n".join(line.rstrip() for line in lines)
