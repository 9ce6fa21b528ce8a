"""Diagnostics as data, and sanitized text of other nodes for logs and messages."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Sequence

_MAX_NAMES = 4


class Level(enum.IntEnum):
    """Severity, with the numbers of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclasses.dataclass(frozen=True)
class Diagnostic:
    """Health of one part of a node.

    Attributes
    ----------
    level : Level
        Severity.
    message : str
        One sentence with value, unit and bound.
    values : dict of str to str
        Counters and readings; keys end in their unit.
    """

    level: Level
    message: str
    values: dict[str, str] = dataclasses.field(default_factory=dict)


def sanitize(text: str, max_length: int = 64) -> str:
    """Return text of another node as one line of bounded length.

    Parameters
    ----------
    text : str
        Text to sanitize.
    max_length : int
        Maximum number of characters; `...` replaces the rest.

    Returns
    -------
    str
        The text with `?` for each character that is not printable.
    """
    kept = text[:max_length]
    if not kept.isprintable():
        kept = "".join(sign if sign.isprintable() else "?" for sign in kept)
    return kept if len(text) <= max_length else kept + "..."


def sanitize_list(names: Sequence[str]) -> str:
    """Return names of other nodes as a list, or `none`; names beyond the fourth are counted."""
    shown = [sanitize(name) for name in names[:_MAX_NAMES]]
    if len(names) > _MAX_NAMES:
        shown.append(f"and {len(names) - _MAX_NAMES} more")
    return ", ".join(shown) or "none"
