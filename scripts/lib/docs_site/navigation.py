"""Navigation of the site, with the sections and order of docs/README.md."""

from __future__ import annotations

import os.path
import re
from collections.abc import Iterable, Mapping

FRONT = "README.md"
OVERVIEW = "docs/README.md"
GENERATED = "<!-- generated pages -->"
"""Placeholder in docs/README.md for the generated pages."""
_FOLDER = "docs"
_SECTION = re.compile(r"^## (.+)$", re.MULTILINE)
_PAGE = re.compile(r"\[([^\]]+)\]\((?![a-z]+:)([^)#]+\.md)\)")


def navigation(overview: str) -> str:
    """Return a hidden table of contents for each section, to append to the front page.

    Parameters
    ----------
    overview : str
        Text of docs/README.md: sections with links to pages.
    """
    _, *sections = _SECTION.split(overview)
    trees = [toctree([f"All pages </{OVERVIEW}>"])]
    for title, text in zip(sections[::2], sections[1::2], strict=True):
        entries: dict[str, str] = {}
        for name, path in _PAGE.findall(text):
            entries.setdefault(os.path.normpath(f"{_FOLDER}/{path}"), name.replace("`", ""))
        trees.append(toctree([f"{name} </{path}>" for path, name in entries.items()], title))
    return "".join(trees)


def toctree(entries: Iterable[str], caption: str = "") -> str:
    """Return a hidden table of contents; empty if there are no entries."""
    lines = [entry.replace(".md", "") for entry in entries]
    if not lines:
        return ""
    head = [":hidden:", ":titlesonly:", *([f":caption: {caption}"] if caption else [])]
    return "\n".join(["", "```{toctree}", *head, "", *lines, "```", ""])


def parts(generated: Iterable[str]) -> dict[str, list[str]]:
    """Return the parts of each page; `x/y.md` is a part of `x.md`."""
    found: dict[str, list[str]] = {name: [] for name in generated if "/" not in name}
    for name in generated:
        whole, slash, _ = name.partition("/")
        if slash:
            found[f"{whole}.md"].append(name)
    return found


def listed(titles: Mapping[str, str]) -> str:
    """Return links to generated pages, one per line, in the form of docs/README.md."""
    return "\n".join(f"- [{title}](reference/{name})" for name, title in titles.items())
