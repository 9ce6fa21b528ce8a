"""Parts of a self-contained HTML page: no script, no reference to another file."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from needle_common.commands.cli import JsonValue

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
figure { margin: 0; } section { break-inside: avoid; }
figcaption, .note { color: var(--soft); font-size: .9rem; margin: 0 0 .4rem; }
img { display: block; width: 100%; max-width: 50rem; height: auto; margin: 0 auto; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .88rem; }
td, th { text-align: left; vertical-align: top; padding: .22rem .6rem .22rem 0;
  border-bottom: 1px solid var(--line); overflow-wrap: anywhere; }
th { color: var(--soft); font-weight: 500; white-space: nowrap; width: 15rem; }
.rows th { width: auto; white-space: normal; } .rows td { font-variant-numeric: tabular-nums; }
.rows td, .rows th { overflow-wrap: break-word; } .rows td:first-child { white-space: nowrap; }
.rows td:last-child { overflow-wrap: anywhere; }
details { margin: .35rem 0; } summary { cursor: pointer; font-weight: 600; }
pre { overflow-x: auto; font-size: .8rem; background: #f5f6f8; padding: .7rem;
  border-radius: .4rem; white-space: pre-wrap; }
@media (max-width: 34rem) { body { padding: .6rem; } header h1 { font-size: 1.5rem; }
  .tiles { grid-template-columns: 1fr 1fr; } th { width: auto; white-space: normal; } }
@media print { body { max-width: none; padding: 0; font-size: 10pt; } details { display: block; }
  header { padding: .6rem .9rem; } header h1 { font-size: 1.5rem; } tr { break-inside: avoid; }
  h2 { break-after: avoid; margin-top: .9rem; } .tiles { grid-template-columns: repeat(6, 1fr); }
  .tiles div { padding: .3rem .45rem; } .tiles dd { font-size: 1.1rem; }
  img { width: auto; max-width: 100%; max-height: 5.3in; }
  section ~ section img { max-height: 8.2in; } }
"""


def page(title: str, parts: Iterable[str]) -> str:
    """Return a page of parts; empty ones are left out."""
    head = (
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{html.escape(title)}</title><style>{_CSS}</style></head><body>",
    )
    return "\n".join([*head, *(part for part in parts if part), "</body></html>", ""])


def banner(words: str, sentence: str, small: str, *, good: bool) -> str:
    """Return the coloured box at the top: the result in words, why, and what was run."""
    kind = ' class="good"' if good else ""
    return (
        f"<header{kind}><h1>{html.escape(words)}</h1><p>{html.escape(sentence)}</p>"
        f"<p><small>{html.escape(small)}</small></p></header>"
    )


def tiles(shown: Iterable[tuple[str, str, str]]) -> str:
    """Return boxes of (label, number, unit)."""
    boxes = (
        f"<div><dt>{html.escape(label)}</dt><dd>{number} <span>{unit}</span></dd></div>"
        for label, number, unit in shown
    )
    return f'<dl class="tiles">{"".join(boxes)}</dl>'


def figure(title: str, caption: str, png: bytes) -> str:
    """Return a heading, a caption and a picture in the page itself."""
    source = base64.b64encode(png).decode("ascii")
    return (
        f"<section><h2>{title}</h2><figure><figcaption>{caption}</figcaption>"
        f'<img alt="{title}" src="data:image/png;base64,{source}"></figure></section>'
    )


def details(title: str, content: str, *, opened: bool = False) -> str:
    """Return content that opens on a click; `content` is HTML, `title` is not."""
    state = " open" if opened else ""
    return f"<details{state}><summary>{html.escape(title)}</summary>{content}</details>"


def pairs(values: Mapping[str, Any]) -> str:
    """Return a table of names and values."""
    rows = "".join(
        f"<tr><th>{html.escape(str(key))}</th><td>{html.escape(as_text(value))}</td></tr>"
        for key, value in values.items()
    )
    return f"<div class=scroll><table>{rows}</table></div>"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table with a heading line."""
    first = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    lines = "".join(
        f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in rows
    )
    return f"<div class=scroll><table class=rows><tr>{first}</tr>{lines}</table></div>"


def note(text: str) -> str:
    """Return a line in small grey letters."""
    return f"<p class=note>{html.escape(text)}</p>"


def as_text(value: Any) -> str:
    """Return a value as a person reads it."""
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def number(value: JsonValue, form: str) -> str:
    """Return a figure in a format, a dash where there is none."""
    return form.format(value) if isinstance(value, (int, float)) else "-"
