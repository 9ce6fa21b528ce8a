"""Reads YAML in which no key stands twice, and says in one line what is wrong with a text."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from needle_core.errors import UserError


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Refuses a mapping with a key that stands twice: the second value would replace the first."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> Any:
        keys: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in keys:
                    raise ValueError(f"duplicate key '{key.value}'{_where(key.start_mark)}")
                keys.add(key.value)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> Any:
    """Return the content of a user's file; a `UserError` says why it cannot be read."""
    try:
        return load_plain(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise UserError(f"{path}: cannot be read: {reason}") from error
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error


def load_plain(text: str) -> Any:
    """Return a document's content.

    Raises
    ------
    ValueError
        If it is not YAML, or repeats a key.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        where = _where(getattr(error, "problem_mark", None))
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise ValueError(f"not YAML{where}: {problem}") from error


def _where(mark: Any) -> str:
    return f" in line {mark.line + 1}" if mark else ""
