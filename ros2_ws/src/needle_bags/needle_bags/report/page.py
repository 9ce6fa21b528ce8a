"""Self-contained HTML pages from the templates in `static/`, and their glossary."""

from __future__ import annotations

import base64
import html
import re
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from needle_bags.figures.figure_style import png_size
from needle_core.commands.cli import JsonValue

_STATIC = Path(__file__).with_name("static")
TERMS = {
    "r1": "distance of the tip from the target plane, positive above it",
    "pitch": "r2, angle between the needle at its tip and the target plane",
    "roll": "r3, rotation of the bevel about the needle axis",
    "bevel": "slanted end of the needle; an advancing needle bends towards its point",
    "truth": "true state of the simulated needle, which no node receives",
    "estimate": "state that the controller computes from tips, joints and its needle model",
    "measured": "from the tracker's images, or from the simulated sensor if there are no images",
    "exposure": "one image pair of the cameras, or one sample of the simulated sensor",
    "RMS": "root mean square: the typical size of an error of either sign",
    "95 %": "95 of 100 values are smaller",
    "sigma": "standard deviation: 95 of 100 errors without a bias are within 2 sigma",
    "innovation": "measured minus predicted tip",
    "gate": "check that rejects a tip too far from the entry point, or from the last tip, for the "
    "motion of the needle",
    "doubtful": "the controller's flag for a tip that may be more than 1 mm off; otherwise the "
    "estimate is trusted",
    "hold": "the hold-to-run switch: the needle moves only while it is pressed",
    "watchdog": "time limit for a missing message; it runs in real time, so a run in which one "
    "tripped may not repeat exactly",
    "step": "insertion from one command to the next, 1 mm by default",
    "rerun": "recorded tips or images processed by the current code; nothing moves",
}
"""Term to its meaning."""

_MARK = re.compile(r"\[([^\]|]+)(?:\|([^\]]+))?\]")


def as_text(value: Any) -> str:
    """Return a value as text, floats with six digits."""
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def number(value: JsonValue, form: str) -> str:
    """Return a formatted number, or a dash for a missing value."""
    return form.format(value) if isinstance(value, (int, float)) else "-"


def base64_text(data: bytes) -> str:
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
    environment.filters.update(anchor=_anchor, base64=base64_text, text=as_text, number=number)
    environment.globals.update(
        png_size=png_size,
        report_css=Markup((_STATIC / "report.css").read_text("utf-8")),
        film_js=Markup((_STATIC / "film.js").read_text("utf-8")),
    )
    return environment


_ENVIRONMENT = _environment()
_PARTS: Any = _ENVIRONMENT.get_template("parts.html").module


class Glossary:
    """Explanations of the terms of a page, each below the text that uses the term first.

    Brackets mark a term in a text: `[roll]`, or `[rolled|roll]` if the words differ. In the page it
    becomes a link to its explanation.
    """

    def __init__(self) -> None:
        self._explained: set[str] = set()

    def explain(self, text: str) -> Markup:
        """Return a marked text as an HTML paragraph, followed by its new terms.

        Raises
        ------
        KeyError
            If a marked term has no explanation.
        """
        new: dict[str, str] = {}

        def link(found: re.Match[str]) -> str:
            shown, term = found[1], found[2] or found[1]
            if term not in self._explained:
                new[term] = TERMS[term]
                self._explained.add(term)
            return str(_PARTS.term(shown, term))

        marked = Markup(_MARK.sub(link, html.escape(text, quote=False)))
        return Markup(_PARTS.note(marked) + _PARTS.terms(new))


def render(template: str, **values: Any) -> str:
    """Return the HTML of a template in `static/`; it refers to no other file."""
    return _ENVIRONMENT.get_template(template).render(values, explain=Glossary().explain)
