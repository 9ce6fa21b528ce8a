"""The report of two runs side by side as one self-contained HTML page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from markupsafe import Markup

from needle_bags.figures.pair_figures import is_same_needle
from needle_bags.reading.bag_reader import Run
from needle_bags.report.glossary import Glossary
from needle_bags.report.html_page import Section, as_text, number, page, parts
from needle_bags.report.report_page import TILE_NOTE, TILES, verdict_text
from needle_core.commands.cli import JsonValue

Summary = Mapping[str, JsonValue]

_SAME_NEEDLE = (
    "State over insertion",
    "Broad grey: the needle, as it was steered once ([truth]); thin: the [estimates|estimate] of A "
    "(blue) and B (orange) of [r1], [pitch] and [roll]. The last row is what each controller "
    "commands for the next [step]: a [rerun] only would have.",
)
_CAPTIONS = {
    "pair_states": (
        "State over insertion",
        "A blue, B orange. Broad and pale: the [truth]; thin: the [estimate] of [r1], [pitch] and "
        "[roll].",
    ),
    "pair_path": ("Path of the needle", "Vertical axes are stretched."),
    "pair_errors": (
        "How good was the measurement, how good the estimate",
        "Each against its own [truth], at equal times of [exposure].",
    ),
}


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
    names = [run.path.absolute().name for run in runs]
    same = is_same_needle(runs)
    captions = {**_CAPTIONS, "pair_states": _SAME_NEEDLE} if same else _CAPTIONS
    note = "Of one insertion: what the needle did is the same in both. " if same else ""
    glossary = Glossary()
    return page(
        f"{names[0]} and {names[1]}",
        _verdict(names, summaries),
        [
            Section(
                "Both runs in figures",
                parts.table(("", "A", "B", "B - A"), _figures(summaries))
                + glossary.explain(note + TILE_NOTE),
            ),
            *(
                Section(title, glossary.explain(text) + parts.figure(title, images[name]))
                for name, (title, text) in captions.items()
                if name in images
            ),
            _differences("How they were made", runs[0].run_info, runs[1].run_info),
            *_parameters(runs),
            _differences("Versions", _versions(runs[0]), _versions(runs[1])),
        ],
    )


def pair_values(summaries: tuple[Summary, Summary]) -> dict[str, JsonValue]:
    """Return the figures of both and their differences as one flat mapping, for --json."""
    values: dict[str, JsonValue] = {}
    for key in summaries[0]:
        a, b = summaries[0][key], summaries[1][key]
        values[f"a_{key}"], values[f"b_{key}"] = a, b
        if _is_number(a) and _is_number(b):
            values[f"difference_{key}"] = b - a  # type: ignore[operator]
    return values


def _verdict(names: list[str], summaries: tuple[Summary, Summary]) -> Markup:
    words = " / ".join(verdict_text(summary)[0] for summary in summaries)
    sentence = " ".join(
        f"{letter}: {verdict_text(summary)[1]}"
        for letter, summary in zip("AB", summaries, strict=True)
    )
    steered = [summary for summary in summaries if summary["rerun_of"] is None]
    good = bool(steered) and all(summary["converged"] is True for summary in steered)
    return parts.banner(words, sentence, f"A is {names[0]} · B is {names[1]}", good=good)


def _figures(summaries: tuple[Summary, Summary]) -> Iterator[tuple[str, ...]]:
    for label, key, form, unit in TILES:
        a, b = summaries[0][key], summaries[1][key]
        if a is None and b is None:
            continue
        difference = "-"
        if _is_number(a) and _is_number(b):
            signed = form.replace("{:", "{:+").replace("++", "+")
            difference = number(b - a, signed)  # type: ignore[operator]
        name = f"{label} [{unit}]" if unit else label
        yield name, number(a, form), number(b, form), difference


def _parameters(runs: tuple[Run, Run]) -> Iterator[Section]:
    """Yield a part for each node; the recorder's place of the bag is no difference."""
    for node in sorted(runs[0].parameters.keys() | runs[1].parameters.keys()):
        if node.endswith("/recorder"):
            continue
        there = [run.parameters.get(node) for run in runs]
        if there[0] is not None and there[1] is not None:
            yield _differences(f"Parameters of {node}", there[0], there[1])
        else:
            letter = "B" if there[0] is None else "A"
            note = parts.note(f"Ran in {letter} only.")
            yield Section(f"Parameters of {node}", note)


def _versions(run: Run) -> dict[str, str]:
    return {"commit": run.commit.replace(run.commit[12:40], "") or "unknown", **run.versions}


def _differences(title: str, first: Mapping[str, Any], second: Mapping[str, Any]) -> Section:
    """Return a table of what differs; a line that says so where nothing does."""
    rows = [
        (str(key), as_text(first.get(key)), as_text(second.get(key)))
        for key in dict.fromkeys((*first, *second))
        if first.get(key) != second.get(key)
    ]
    if not rows:
        return Section(title, parts.note("The same in both."))
    return Section(title, parts.table(("", "A", "B"), rows))


def _is_number(value: JsonValue) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
