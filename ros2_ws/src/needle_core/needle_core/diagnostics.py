"""Diagnostics as data, and sanitised text of other nodes for logs and messages."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Sequence


class Level(enum.IntEnum):
    """Severity, with diagnostic_msgs/DiagnosticStatus's numbers."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclasses.dataclass(frozen=True)
class Diagnostic:
    """One line of health.

    Attributes
    ----------
    level : Level
        How bad it is.
    message : str
        One sentence with value, unit and bound.
    values : dict of str to str
        Counters and readings; keys end in their unit.
    """

    level: Level
    message: str
    values: dict[str, str] = dataclasses.field(default_factory=dict)


def sanitize(text: str, longest: int = 64) -> str:
    """Return foreign text in one line of bounded length.

    Parameters
    ----------
    text : str
        What somebody sent.
    longest : int
        How many characters of it are kept; `...` stands for the rest.

    Returns
    -------
    str
        The text, `?` for each character that does not print.
    """
    kept = text[:longest]
    if not kept.isprintable():
        kept = "".join(sign if sign.isprintable() else "?" for sign in kept)
    return kept if len(text) <= longest else kept + "..."


def sanitize_list(names: Sequence[str], most: int = 4) -> str:
    """Return foreign names one after the other, how many more there are, or `none`.

    Parameters
    ----------
    names : sequence of str
        What somebody sent.
    most : int
        How many of them are told.
    """
    told = [sanitize(name) for name in names[:most]]
    if len(names) > most:
        told.append(f"and {len(names) - most} more")
    return ", ".join(told) or "none"
