"""Reader of a page's messages: whatever is not exactly as agreed is garbage."""

from __future__ import annotations

import dataclasses
import json

from needle_console.hold.hold_state import Mode

_KEYS = {"count", "pressed", "speed", "mode"}


class GarbageError(ValueError):
    """A message that is not understood."""


@dataclasses.dataclass(frozen=True)
class PageMessage:
    """One message of a page.

    Attributes
    ----------
    count : int
        The newest of the server's counts that it has heard.
    pressed : bool
        Whether its button is held.
    speed : float
        Share of the nominal speed, 0..1.
    mode : Mode
        What for.
    """

    count: int
    pressed: bool
    speed: float
    mode: Mode


def read_message(data: str | bytes) -> PageMessage:
    """Read a page's message.

    Raises
    ------
    GarbageError
        If it is not exactly as agreed: unknown or missing keys, other types, a speed that is no
        number or outside 0..1.
    """
    try:
        fields = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise GarbageError("no JSON") from error
    if not isinstance(fields, dict) or fields.keys() != _KEYS:
        raise GarbageError("other keys")
    count, pressed, speed = fields["count"], fields["pressed"], fields["speed"]
    if type(count) is not int or type(pressed) is not bool:
        raise GarbageError("other types")
    if type(speed) not in (int, float) or not 0.0 <= speed <= 1.0:
        raise GarbageError("no speed within 0..1")
    try:
        return PageMessage(count, pressed, float(speed), Mode(fields["mode"]))
    except ValueError as error:
        raise GarbageError("unknown mode") from error
