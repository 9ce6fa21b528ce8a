"""Page of diagnostics: parts and keys of each node, and the texts of warnings and errors."""

from __future__ import annotations

import ast
import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

from reference.endpoints import SOURCES
from reference.markdown import code, node_link, table
from reference.rig_nodes import IN_EVERY_NODE, RigNode

LEVELS = ("WARN", "ERROR")
_FILLED_IN = "..."


@dataclasses.dataclass(frozen=True)
class DiagnosticText:
    """Warning or error text in the code.

    Attributes
    ----------
    package, module : str
        Package, and path of the module below it.
    level : str
        WARN or ERROR.
    text : str
        The text; `...` stands for values, or for text from another module.
    """

    package: str
    module: str
    level: str
    text: str


def diagnostic_texts() -> list[DiagnosticText]:
    """Return every warning and error text of the runtime packages."""
    return [
        each
        for path in sorted(SOURCES.glob("*/*/**/*.py"))
        if path.relative_to(SOURCES).parts[1] != "test"
        for each in diagnostic_texts_in(path)
    ]


def diagnostic_texts_in(path: Path) -> Iterator[DiagnosticText]:
    """Yield the texts of a module: `Level.WARN, text` in a call, a tuple or a table."""
    package, _, *rest = path.relative_to(SOURCES).parts
    source = path.read_text("utf-8")
    # Parse only modules with diagnostics, because parsing takes most of the time.
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
                yield DiagnosticText(package, "/".join(rest), level, _text(words))


def _levels(item: ast.expr) -> list[str]:
    """Return the levels that an expression may have."""
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
            str(part.value) if isinstance(part, ast.Constant) else _FILLED_IN
            for part in words.values
        )
    if isinstance(words, ast.Attribute):
        # A state: `State.FAULT`.
        return f"{words.attr}: {_FILLED_IN}" if words.attr.isupper() else _FILLED_IN
    return _FILLED_IN


def diagnostics_page(nodes: Sequence[RigNode]) -> str:
    """Return the page of diagnostics."""
    parts = [
        (node_link(node.name), code(part), ", ".join(map(code, keys)))
        for node in nodes
        for part, keys in node.parts.items()
    ]
    rows = [
        (code(each.package), code(each.module.removesuffix(".py")), each.level, code(each.text))
        for each in dict.fromkeys(diagnostic_texts())
    ]
    every = [(code(part), text) for part, text in IN_EVERY_NODE.items()]
    return (
        "# Diagnostics\n\nEvery node publishes its state on `/diagnostics`, once a second and on "
        "every change, part by part, as `NODE: PART`. The READMEs of the packages list remedies."
        "\n\n"
        "## Parts\n\n"
        + table(("node", "part", "keys of its values"), parts)
        + "In every node:\n\n"
        + table(("part", "a warning that"), every)
        + "## Warnings and errors\n\n`...` stands for values.\n\n"
        + table(("package", "module", "level", "message"), rows)
    )
