"""Markdown: cells, tables, links."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def cell(text: str) -> str:
    """Return text as it may stand in a table."""
    return " ".join(text.split()).replace("|", "\\|")


def code(text: str) -> str:
    """Return text as code, also with backticks in it."""
    return f"`` {text} ``" if "`" in text else f"`{text}`"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table, with an empty line after it; nothing where there are no rows."""
    lines = [f"| {' | '.join(map(cell, row))} |" for row in rows]
    if not lines:
        return ""
    return "\n".join([f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}", *lines, "", ""])


def block(text: str) -> str:
    """Return text as it was printed."""
    return f"```text\n{text.rstrip()}\n```\n\n"


def node_link(name: str, folder: str = "") -> str:
    """Return a link to a node's page."""
    return f"[`{name}`]({folder}{name}.md)"
