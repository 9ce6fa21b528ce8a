"""Reads YAML from outside: nothing that grows, or nests without end, when it is read."""

from __future__ import annotations

from typing import Any, Final

import yaml

_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
# The C parser builds values by recursion, and has no bound of its own.
DEPTH_LIMIT: Final = 100


def load_plain(text: str) -> Any:
    """Return a document's content.

    Raises
    ------
    ValueError
        If it is no YAML, nests too deep, or has aliases (of which a few lines make gigabytes).
    """
    depth = 0
    try:
        for event in yaml.parse(text, Loader=_Loader):
            if isinstance(event, yaml.AliasEvent):
                raise ValueError("it has YAML aliases, which are not read")
            if isinstance(event, yaml.CollectionStartEvent):
                depth += 1
            elif isinstance(event, yaml.CollectionEndEvent):
                depth -= 1
            if depth > DEPTH_LIMIT:
                raise ValueError(f"it nests more than {DEPTH_LIMIT} deep")
        return yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        raise ValueError(f"it is no YAML: {str(error).splitlines()[0]}") from error
