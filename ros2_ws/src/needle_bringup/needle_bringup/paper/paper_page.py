"""The page `docs/paper.md`: values from the paper and from this project, and the figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from needle_bringup.paper.paper_figures import common_r1, converged_share
from needle_bringup.paper.paper_results import (
    DEPTH_MM,
    DOMAIN_PITCH_DEG,
    DOMAIN_ROLL_DEG,
    GRIDS,
    LONGER_MM,
    SCALES,
    PaperRuns,
    final_r1_mm,
    missed_later,
    settled_mm,
)
from needle_bringup.studies.pure_insertions import RADIUS
from needle_core.commands.cli import JsonValue

_TEMPLATE = Path(__file__).with_name("static") / "paper_page.txt"
Row = tuple[str, str, str, str]


def page(results: PaperRuns) -> str:
    """Return the whole page."""
    lines = ["| what | paper | here | remark |", "| --- | --- | --- | --- |"]
    lines += ["| " + " | ".join(row) + " |" for row in table(results)]
    return _TEMPLATE.read_text("utf-8").replace("@ROWS@", "\n".join(lines))


def table(results: PaperRuns) -> Iterator[Row]:
    """Yield (quantity, value of the paper, value here, remark)."""
    yield (
        "figure 3, open loop: r1 at 120 mm",
        '"rapidly diverged"',
        f"{final_r1_mm(results.open_loop):.2f} mm",
        "closed form: 14.62 mm",
    )
    closed = results.closed_loop
    settled = settled_mm(closed.insertion_mm, closed.truth[:, 0])
    yield (
        "figure 3, closed loop: settled within ±1 mm",
        '"within about 5 cm"',
        f"{_figure(results.start, 'settle_median_mm', 0)} mm (median of {results.start['runs']} "
        f"seeds), {settled:.0f} mm with the seed shown",
        "the paper gives no gains",
    )
    insertion, r1 = common_r1(results.trials)
    last = np.abs(r1[:, insertion > DEPTH_MM - 20.5])
    each = sorted(settled_mm(insertion, row) for row in r1)
    median = each[len(each) // 2]
    slower = median > _number(results.start, "settle_median_mm")
    yield (
        "figure 4: trials within ±1 mm over the last 20 mm",
        "9 of 9",
        f"{int(np.sum(np.all(last <= 1.0, axis=1)))} of {len(results.trials)}",
        "camera noise here 0.05 mm, in the paper 1 mm",
    )
    yield (
        "figure 4: settled within ±1 mm",
        '"more sluggish" than simulated',
        f"{median:.0f} mm (median), {each[-1]:.0f} mm (slowest)",
        f"{'slower here as well' if slower else 'no slower here'}; "
        "assumed torsion: ±10 deg of play, 2 mm of lag",
    )
    yield from _study_rows(results)
    yield from _robustness_rows(results)
    yield from _curvature_rows(results)


def key_figures(results: PaperRuns) -> dict[str, JsonValue]:
    """Return the figures for `--json`."""
    _, r1 = common_r1(results.trials)
    values: dict[str, JsonValue] = {
        "open_loop_r1_final_mm": final_r1_mm(results.open_loop),
        "closed_loop_r1_final_mm": final_r1_mm(results.closed_loop),
        "closed_loop_settle_median_mm": results.start["settle_median_mm"],
        "trials": len(results.trials),
        "trials_within_1_mm": int(np.sum(np.abs(r1[:, -1]) <= 1.0)),
        "best_converged_at_end": results.best["converged_at_end"],
        "curvature_radius_mm": results.curvature["radius_mm"],
        "curvature_arc_bias": results.curvature_errors.bias,
        "curvature_arc_spread": results.curvature_errors.spread,
        "curvature_circle_bias": results.curvature_errors.circle_bias,
    }
    for grid in GRIDS:
        missed, still, worst = missed_later(results.runs[grid], results.longer[grid])
        values |= {
            f"{grid}_runs": results.grids[grid]["runs"],
            f"{grid}_converged_at_end": results.grids[grid]["converged_at_end"],
            f"{grid}_converged_last_20": results.grids[grid]["converged_last_20"],
            f"{grid}_missed": missed,
            f"{grid}_missed_also_later": still,
            f"{grid}_missed_worst_later_mm": worst,
        }
    for scale in SCALES:
        key = f"kappa_scale_{scale:g}_converged_at_end".replace(".", "_")
        values[key] = results.scales[scale]["converged_at_end"]
    return values


def _study_rows(results: PaperRuns) -> Iterator[Row]:
    for grid in GRIDS:
        figures = results.grids[grid]
        yield (
            f"{grid} grid: within ±1 mm at {DEPTH_MM:.0f} mm / over the last 20 steps",
            "98.56 %",
            f"{_percent(figures, 'converged_at_end')} / {_percent(figures, 'converged_last_20')}",
            "the paper gives neither weights, grid nor criterion"
            if grid == "endpoint"
            else "likewise",
        )
    for grid in GRIDS:
        missed, still, worst = missed_later(results.runs[grid], results.longer[grid])
        yield (
            f"{grid} grid: runs that missed",
            "144 of 10,000; none diverged",
            f"{missed} of {results.grids[grid]['runs']}; {missed - still} of them within ±1 mm at "
            f"{LONGER_MM:.0f} mm, the worst {worst:.1f} mm off",
            "none diverges" if worst < 10.0 else "some diverge",
        )
    yield (
        "endpoint grid with `best`",
        "",
        f"{_percent(results.best, 'converged_at_end')} / "
        f"{_percent(results.best, 'converged_last_20')}",
        "",
    )


def _robustness_rows(results: PaperRuns) -> Iterator[Row]:
    signs = ", ".join(f"{100.0 * (scale - 1.0):+.0f}" for scale in SCALES)
    at_end = ", ".join(_percent(results.scales[scale], "converged_at_end") for scale in SCALES)
    later = ", ".join(
        _percent(results.scales_longer[scale], "converged_at_end") for scale in SCALES
    )
    settle = ", ".join(_figure(results.scales[scale], "settle_median_mm", 0) for scale in SCALES)
    yield (
        f"curvature wrong by {signs} %: within ±1 mm at {DEPTH_MM:.0f}; at {LONGER_MM:.0f} mm",
        '"always converged, albeit slower"',
        f"{at_end}; {later}",
        f"median settling {settle} mm, with the true curvature "
        f"{_figure(results.grids['endpoint'], 'settle_median_mm', 0)} mm",
    )
    by_pitch = converged_share(results.domain_pitch, "pitch_deg", DOMAIN_PITCH_DEG)
    by_roll = converged_share(results.domain_roll, "roll_deg", DOMAIN_ROLL_DEG)
    yield (
        "domain of attraction",
        '"quite large"',
        f"{100.0 * np.nanmean(by_pitch > 0.5):.0f} % of the (x, pitch) shown and "
        f"{100.0 * np.nanmean(by_roll > 0.5):.0f} % of (x, roll) converge in most runs",
        "",
    )


def _curvature_rows(results: PaperRuns) -> Iterator[Row]:
    found, errors = results.curvature, results.curvature_errors
    low, high = _figure(found, "radius_low_mm", 1), _figure(found, "radius_high_mm", 1)
    yield (
        "1/kappa from 60 mm of pure insertion, by cameras",
        "12.2 cm",
        f"{_number(found, 'radius_mm') / 10.0:.2f} cm (95 %: {low} to {high} mm)",
        f"true: {RADIUS * 1e2:.1f} cm",
    )
    yield (
        "the same with ±1 mm noise: least-squares circle, most likely arc",
        "",
        f"circle: kappa {100.0 * errors.circle_bias:+.0f} ± {100.0 * errors.circle_spread:.0f} %; "
        f"arc: 1/kappa {100.0 * errors.bias:+.1f} ± {100.0 * errors.spread:.1f} %",
        "",
    )


def _percent(figures: dict[str, JsonValue], key: str) -> str:
    return f"{100.0 * _number(figures, key):.2f} %"


def _figure(figures: dict[str, JsonValue], key: str, digits: int) -> str:
    return "-" if figures[key] is None else f"{_number(figures, key):.{digits}f}"


def _number(figures: dict[str, JsonValue], key: str) -> float:
    value = figures[key]
    return float(value) if isinstance(value, (int, float)) else float("nan")


def as_text(rows: Sequence[Row]) -> str:
    """Return the table for a terminal."""
    lines = []
    for what, *cells in rows:
        labelled = zip(("paper", "here", "remark"), cells, strict=True)
        lines += [what, *(f"    {label:8}{cell}" for label, cell in labelled if cell)]
    return "\n".join(lines)
