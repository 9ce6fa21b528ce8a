"""The hold that a person asks for: pressed or not, how fast, which way."""

from __future__ import annotations

import dataclasses
import enum

OWNER = "console"
"""Name by which the device knows the console's hold."""


class Mode(enum.Enum):
    """Purpose of a press."""

    INSERT = "insert"
    RETRACT = "retract"


@dataclasses.dataclass(frozen=True)
class HoldState:
    """The hold that counts.

    Attributes
    ----------
    pressed : bool
        Whether somebody holds.
    speed : float
        Share of the nominal speed, 0..1; 0 where nobody holds.
    mode : Mode
        What it is held for.
    """

    pressed: bool
    speed: float
    mode: Mode


RELEASED = HoldState(False, 0.0, Mode.INSERT)
