"""Reads YAML: no key twice, and from outside nothing that grows, or nests without end."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import yaml

from needle_core.errors import UserError

_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
# The C parser builds values by recursion, and has no bound of its own.
DEPTH_LIMIT: Final = 100


def read_yaml(path: Path) -> Any:
    """Return the content of a user's file; a `UserError` says why it cannot be read."""
    try:
        return load_plain(path.read_text(encoding="utf-8"), aliases=True)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise UserError(f"{path}: cannot be read: {reason}") from error
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error


def load_plain(text: str, *, aliases: bool = False) -> Any:
    """Return a document's content.

    Parameters
    ----------
    text : str
        The document.
    aliases : bool
        Whether it may have aliases, of which a few lines make gigabytes.

    Raises
    ------
    ValueError
        If it is not YAML, repeats a key, nests too deep, or has aliases that it may not have.
    """
    try:
        _check(text, aliases)
        return yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        where = _where(getattr(error, "problem_mark", None))
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise ValueError(f"not YAML{where}: {problem}") from error


def _check(text: str, aliases: bool) -> None:
    # Of each open collection: its keys, and whether the next node is one. A sequence has none.
    open_collections: list[tuple[set[str], bool] | None] = []
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.CollectionEndEvent):
            open_collections.pop()
        if not isinstance(event, yaml.NodeEvent):
            continue
        if isinstance(event, yaml.AliasEvent) and not aliases:
            raise ValueError("it has YAML aliases, which are not read")
        if open_collections and open_collections[-1] is not None:
            keys, is_key = open_collections[-1]
            open_collections[-1] = (keys, not is_key)
            if is_key and isinstance(event, yaml.ScalarEvent):
                if event.value in keys:
                    raise ValueError(f"duplicate key '{event.value}'{_where(event.start_mark)}")
                keys.add(event.value)
        if isinstance(event, yaml.CollectionStartEvent):
            is_mapping = isinstance(event, yaml.MappingStartEvent)
            open_collections.append((set(), True) if is_mapping else None)
            if len(open_collections) > DEPTH_LIMIT:
                raise ValueError(f"it nests more than {DEPTH_LIMIT} deep")


def _where(mark: Any) -> str:
    return f" in line {mark.line + 1}" if mark else ""
