"""Health of a part of the rig, as data."""

from __future__ import annotations

import dataclasses
import enum


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
