"""Markdown cells, tables and links."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

NODES = "nodes/"
"""Folder of the nodes' pages, in the folder of the other pages."""


def cell(text: str) -> str:
    """Return text escaped for a table cell."""
    return " ".join(text.split()).replace("|", "\\|")


def code(text: str) -> str:
    """Return text, which may contain backticks, as inline code."""
    return f"`` {text} ``" if "`" in text else f"`{text}`"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table and an empty line, without empty columns; empty if there are no rows."""
    rows = list(rows)
    used = [k for k in range(len(head)) if any(row[k] for row in rows)]
    lines = [f"| {' | '.join(cell(row[k]) for k in used)} |" for row in rows]
    if not lines:
        return ""
    titles = " | ".join(head[k] for k in used)
    return "\n".join([f"| {titles} |", f"|{' --- |' * len(used)}", *lines, "", ""])


def block(text: str, language: str = "text") -> str:
    """Return text as a fenced block."""
    fence = max(["```", *(f"{ticks}`" for ticks in re.findall(r"`{3,}", text))], key=len)
    return f"{fence}{language}\n{text.rstrip()}\n{fence}\n\n"


def node_link(name: str) -> str:
    """Return a link to a node's page."""
    return f"[`{name}`]({NODES}{name}.md)"
