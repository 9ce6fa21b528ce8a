"""The comparison of two runs as one HTML page (`static/pair.html`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from needle_bags.figures.pair_figures import is_same_needle
from needle_bags.reading.bag_reader import Run
from needle_bags.report.page import number, render
from needle_bags.report.report_page import TILES, verdict_text
from needle_core.commands.cli import JsonValue

Summary = Mapping[str, JsonValue]


def build_pair_page(
    runs: tuple[Run, Run], summaries: tuple[Summary, Summary], images: Mapping[str, bytes]
) -> str:
    """Return the page.

    Parameters
    ----------
    runs, summaries : pairs
        A and B: the runs and their figures, from `run_summary.summarize`.
    images : mapping
        Figure name to PNG data.

    Returns
    -------
    str
        HTML without references to other files.
    """
    steered = [summary for summary in summaries if summary["rerun_of"] is None]
    return render(
        "pair.html",
        names=[run.path.absolute().name for run in runs],
        runs=runs,
        # The recorder's parameters name the bag, which always differs.
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
        yield name, number(a, form), number(b, form), number(_difference(a, b), signed)


def _difference(a: JsonValue, b: JsonValue) -> float | None:
    """Return b - a, or None unless both are numbers."""
    if isinstance(a, bool) or isinstance(b, bool):
        return None
    if not isinstance(a, (int, float)) or not isinstance(b, (int, float)):
        return None
    return b - a
