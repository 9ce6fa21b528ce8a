"""Parts of a self-contained HTML page, of `static/parts.html`: no reference to another file."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup

from needle_bags.figures.figure_style import png_size
from needle_core.commands.cli import JsonValue

_STATIC = Path(__file__).with_name("static")


class Section(NamedTuple):
    """A part of a page with a heading; without content it is left out.

    Attributes
    ----------
    title : str
        Plain text, no other section's.
    content : Markup
        HTML.
    """

    title: str
    content: Markup


def as_text(value: Any) -> str:
    """Return a value as a person reads it."""
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def base64_text(data: bytes) -> str:
    """Return data as a `data:` address has it."""
    return base64.b64encode(data).decode("ascii")


def _anchor(title: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


class Parts(Protocol):
    """The macros of `parts.html`."""

    def __getattr__(self, name: str) -> Callable[..., Markup]: ...


def _parts() -> Any:
    environment = Environment(
        loader=FileSystemLoader(_STATIC), autoescape=True, trim_blocks=True, cache_size=0
    )
    environment.filters.update(anchor=_anchor, base64=base64_text, text=as_text)
    environment.globals.update(
        png_size=png_size,
        report_css=Markup((_STATIC / "report.css").read_text("utf-8")),
        film_js=Markup((_STATIC / "film.js").read_text("utf-8")),
    )
    return environment.get_template("parts.html").module


parts: Parts = _parts()


def page(title: str, top: Markup, sections: Iterable[Section]) -> str:
    """Return a page: what stands at its top, contents, and its sections."""
    return str(parts.page(title, top, [section for section in sections if section.content]))


def number(value: JsonValue, form: str) -> str:
    """Return a figure in a format, a dash where there is none."""
    return form.format(value) if isinstance(value, (int, float)) else "-"
