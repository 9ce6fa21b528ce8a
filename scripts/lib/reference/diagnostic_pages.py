"""The page of diagnostics: parts and keys as nodes set them, warnings and errors as worded."""

from __future__ import annotations

import ast
import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

from reference.endpoints import SOURCES
from reference.markdown import code, node_link, table
from reference.node_pages import NODES
from reference.rig_nodes import RigNode

LEVELS = ("WARN", "ERROR")
IN_EVERY_NODE = {
    "input": "a message or request was refused, or the node failed on it; counted by topic",
    "duplicates": "another node publishes a topic that only this node should",
}
"""Parts that any node may report, by `needle_core.ros`."""
_WORDS = "..."


@dataclasses.dataclass(frozen=True)
class Complaint:
    """A place in the code where a warning or error is worded.

    Attributes
    ----------
    package, module : str
        Where; the module's path below the package's own.
    line : int
        From 1.
    level : str
        WARN or ERROR.
    text : str
        The words; `...` stands for what is filled in, or for words of another place.
    """

    package: str
    module: str
    line: int
    level: str
    text: str


def complaints() -> list[Complaint]:
    """Return every place of the runtime packages that words a warning or an error."""
    return [
        each
        for path in sorted(SOURCES.glob("*/*/**/*.py"))
        if path.relative_to(SOURCES).parts[1] != "test"
        for each in complaints_in(path)
    ]


def complaints_in(path: Path) -> Iterator[Complaint]:
    """Yield those of a module: `Level.WARN, words`, in a call, a tuple or a table."""
    package, _, *rest = path.relative_to(SOURCES).parts
    source = path.read_text("utf-8")
    # Few modules do: to understand the others takes most of the time.
    if "Level." not in source:
        return
    for part in ast.walk(ast.parse(source)):
        beside: list[tuple[ast.expr, ast.expr | None]] = []
        if isinstance(part, (ast.Call, ast.Tuple)):
            items = part.args if isinstance(part, ast.Call) else part.elts
            beside = list(zip(items, [*items, None][1:], strict=True))
        elif isinstance(part, ast.Dict):
            beside = [(value, key) for key, value in zip(part.keys, part.values, strict=True)]
        for item, words in beside:
            for level in _levels(item):
                yield Complaint(package, "/".join(rest), item.lineno, level, _text(words))


def _levels(item: ast.expr) -> list[str]:
    """Return the levels that an expression is, or chooses from."""
    if isinstance(item, ast.IfExp):
        return [*_levels(item.body), *_levels(item.orelse)]
    if not isinstance(item, ast.Attribute) or getattr(item.value, "id", "") != "Level":
        return []
    return [item.attr] if item.attr in LEVELS else []


def _text(words: ast.expr | None) -> str:
    if isinstance(words, ast.Constant):
        return str(words.value)
    if isinstance(words, ast.JoinedStr):
        return "".join(
            str(part.value) if isinstance(part, ast.Constant) else _WORDS for part in words.values
        )
    if isinstance(words, ast.Attribute):
        # A state: `State.FAULT`.
        return f"{words.attr}: {_WORDS}" if words.attr.isupper() else _WORDS
    return _WORDS


def diagnostics_page(nodes: Sequence[RigNode]) -> str:
    """Return the page."""
    parts = [
        (node_link(node.name, NODES), code(part), ", ".join(map(code, keys)))
        for node in nodes
        for part, keys in node.parts.items()
    ]
    worded = {(each.package, each.module, each.level, each.text): each for each in complaints()}
    rows = [
        (
            f"{code(each.package)}",
            code(each.module.removesuffix(".py")),
            each.level,
            code(each.text),
        )
        for each in worded.values()
    ]
    every = [(code(part), text) for part, text in IN_EVERY_NODE.items()]
    return (
        "# Diagnostics\n\nEvery node reports its health on `/diagnostics`, once a second and "
        "whenever it changes, part by part, as `NODE: PART`. The packages' READMEs describe "
        "the remedies.\n\n"
        "## Parts\n\n"
        + table(("node", "part", "keys of its values"), parts)
        + "In every node:\n\n"
        + table(("part", "a warning that"), every)
        + "## What warns and what fails\n\nAs the code words it; `...` is filled in.\n\n"
        + table(("package", "module", "level", "message"), rows)
    )
