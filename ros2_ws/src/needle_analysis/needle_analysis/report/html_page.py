"""Parts of a self-contained HTML page: no reference to another file."""

from __future__ import annotations

import base64
import dataclasses
import html
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from needle_analysis.figures.figure_style import png_size
from needle_core.commands.cli import JsonValue

_CSS = """
:root { color-scheme: light dark; --ink: #16191d; --soft: #565e68; --line: #dfe3e8;
  --ground: #fff; --box: #f3f5f7; --link: #0b57a4; --good: #1a7340; --bad: #b3261e;
  --needle: #0067b1; --tip: #cf6a00; --under: #fff; }
@media screen and (prefers-color-scheme: dark) {
  :root { --ink: #e6e8eb; --soft: #a3abb5; --line: #3a3f46; --ground: #141414; --box: #202327;
    --link: #7db8f2; --needle: #59b0ee; --tip: #e58a2b; --under: #141414; }
  /* Charts are drawn dark on white: lightness turned round, hues kept. */
  img.chart { filter: invert(.92) hue-rotate(180deg); } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 60rem; padding: 1rem; color: var(--ink);
  background: var(--ground);
  font: 16px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
a { color: var(--link); }
header { border-radius: .6rem; padding: 1.1rem 1.3rem; color: #fff; background: var(--bad);
  print-color-adjust: exact; -webkit-print-color-adjust: exact; }
header.good { background: var(--good); }
header h1 { margin: 0; font-size: 1.9rem; line-height: 1.15; }
header p { margin: .45rem 0 0; font-size: 1.05rem; overflow-wrap: anywhere; }
nav ul { display: flex; flex-wrap: wrap; gap: .1rem 1.1rem; margin: .8rem 0 0; padding: 0;
  list-style: none; font-size: .92rem; }
nav a { display: inline-block; padding: .2rem 0; }
.tiles { display: grid; gap: .6rem; margin: .9rem 0 .5rem; padding: 0;
  grid-template-columns: repeat(auto-fit, minmax(9.2rem, 1fr)); }
.tiles div { border: 1px solid var(--line); border-radius: .5rem; padding: .55rem .75rem; }
.tiles dt { color: var(--soft); font-size: .8rem; line-height: 1.25; }
.tiles dd { margin: .1rem 0 0; font-size: 1.35rem; font-weight: 650;
  font-variant-numeric: tabular-nums; }
.tiles dd span { font-size: .85rem; font-weight: 400; color: var(--soft); }
h2 { font-size: 1.2rem; margin: 1.8rem 0 .3rem; }
figure { margin: 0; } section { break-inside: avoid; }
.note { color: var(--soft); font-size: .9rem; margin: 0 0 .4rem; }
.term { color: inherit; text-decoration: underline dotted; text-underline-offset: .2em; }
.terms { margin: 0 0 .6rem; padding: .45rem .7rem; border-radius: .4rem; background: var(--box);
  font-size: .85rem; line-height: 1.4; columns: 22rem; column-gap: 1.5rem;
  print-color-adjust: exact; -webkit-print-color-adjust: exact; }
.terms div { break-inside: avoid; } .terms dt { display: inline; font-weight: 650; }
.terms dt::after { content: ": "; } .terms dd { display: inline; margin: 0; }
.terms div:target { outline: 2px solid var(--link); outline-offset: 2px; }
img { display: block; width: 100%; height: auto; margin: 0 auto; }
figure > img { max-width: 46rem; }
.views { display: grid; gap: .5rem .8rem; margin-top: .5rem; grid-template-columns: 1fr 1fr; }
.view figcaption { color: var(--soft); font-size: .85rem; } .stack { position: relative; }
.stack svg { position: absolute; inset: 0; width: 100%; height: 100%; }
.stack polyline, .stack circle { fill: none; vector-effect: non-scaling-stroke;
  stroke-linejoin: round; stroke-linecap: round; }
.needle { stroke: var(--needle); stroke-width: 2px; }
.tip { stroke: var(--tip); stroke-width: 2px; }
.under { stroke: var(--under); stroke-width: 4px; }
/* Over pictures the same in both modes. */
.photo .needle { stroke: #59b0ee; stroke-width: 1.2px; } .photo .tip { stroke: #ff9a2e; }
.photo .under { stroke: #101010; stroke-width: 3px; }
.photo polyline.under { stroke-width: 2.4px; }
.controls { display: flex; gap: .8rem; align-items: center; }
.controls[hidden] { display: none; }
.controls button { min-width: 5.5rem; min-height: 2.75rem; font: inherit; font-weight: 600;
  color: var(--ground); background: var(--link); border: 0; border-radius: .4rem;
  cursor: pointer; }
.controls input { flex: 1; min-width: 0; height: 2.75rem; accent-color: var(--link); }
:focus-visible { outline: 3px solid var(--link); outline-offset: 2px; }
.readings { display: grid; gap: .1rem .8rem; margin: .3rem 0;
  grid-template-columns: repeat(auto-fit, minmax(7rem, auto)); }
.readings dt { color: var(--soft); font-size: .78rem; } .readings dd { margin: 0;
  font-weight: 600; font-variant-numeric: tabular-nums; }
.scroll { overflow-x: auto; margin-bottom: .6rem; }
table { border-collapse: collapse; width: 100%; font-size: .88rem; }
td, th { text-align: left; vertical-align: top; padding: .22rem .6rem .22rem 0;
  border-bottom: 1px solid var(--line); overflow-wrap: anywhere; }
th { color: var(--soft); font-weight: 500; white-space: nowrap; width: 15rem; }
.rows th { width: auto; white-space: normal; } .rows td { font-variant-numeric: tabular-nums; }
.rows td, .rows th { overflow-wrap: break-word; } .rows td:first-child { white-space: nowrap; }
.rows td:last-child { overflow-wrap: anywhere; }
details { margin: .35rem 0; } summary { cursor: pointer; font-weight: 600; }
pre { overflow-x: auto; font-size: .85rem; background: var(--box); padding: .6rem .7rem;
  border-radius: .4rem; white-space: pre-wrap; overflow-wrap: anywhere; margin: .3rem 0 .6rem; }
@media (max-width: 34rem) { body { padding: .6rem; } header h1 { font-size: 1.5rem; }
  .tiles { grid-template-columns: 1fr 1fr; } th { width: auto; white-space: normal; }
  .views { grid-template-columns: 1fr; }
  .readings { grid-template-columns: 1fr 1fr 1fr; } .rows td:first-child { white-space: normal; } }
@media print { body { max-width: none; padding: 0; font-size: 9.5pt; }
  header { padding: .5rem .9rem; } header h1 { font-size: 1.4rem; } tr { break-inside: avoid; }
  nav, .controls { display: none; } details:not([open]) { display: none; }
  h2 { break-after: avoid; margin-top: .7rem; } .tiles { grid-template-columns: repeat(7, 1fr); }
  .tiles { gap: .3rem; } .tiles div { padding: .2rem .4rem; } .tiles dd { font-size: 1rem; }
  .tiles dt { font-size: .68rem; } .terms { font-size: .78rem; padding: .2rem .5rem; }
  .readings { grid-template-columns: repeat(7, auto); } .view.photo { max-width: 15rem; }
  section { break-inside: auto; } figure, .film, .scroll { break-inside: avoid; }
  .note, .terms { break-inside: avoid; break-after: avoid; }
  figure > img { width: 4.6in; max-width: 100%; } }
"""


@dataclasses.dataclass(frozen=True)
class Section:
    """A part of a page with a heading; without content it is left out.

    Attributes
    ----------
    title : str
        Plain text, no other section's.
    content : str
        HTML.
    """

    title: str
    content: str

    @property
    def anchor(self) -> str:
        """Name by which links lead here."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-")


def page(title: str, top: str, sections: Iterable[Section]) -> str:
    """Return a page: what stands at its top, contents, and its sections."""
    shown = [section for section in sections if section.content]
    links = "".join(f'<li><a href="#{s.anchor}">{html.escape(s.title)}</a></li>' for s in shown)
    head = (
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{html.escape(title)}</title><style>{_CSS}</style></head><body>",
    )
    parts = (
        f'<section id="{s.anchor}"><h2>{html.escape(s.title)}</h2>{s.content}</section>'
        for s in shown
    )
    contents = f'<nav aria-label="Contents"><ul>{links}</ul></nav>'
    return "\n".join([*head, top, contents, *parts, "</body></html>", ""])


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


def figure(title: str, png: bytes, *, photo: bool = False) -> str:
    """Return a picture in the page itself; `photo`: its colours are kept also in the dark."""
    width, height = png_size(png)
    kind = "photo" if photo else "chart"
    source = base64.b64encode(png).decode("ascii")
    return (
        f'<figure><img class="{kind}" alt="{html.escape(title)}" width="{width}" '
        f'height="{height}" src="data:image/png;base64,{source}"></figure>'
    )


def code(text: str) -> str:
    """Return a command, or text that is set as one."""
    return f"<pre>{html.escape(text)}</pre>"


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
