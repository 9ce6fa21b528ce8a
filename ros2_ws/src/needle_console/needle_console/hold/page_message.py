"""Strict reader of a page's messages: whatever is not exactly as agreed is garbage."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

from needle_console.hold.hold_state import Mode

LONGEST = 256
"""Longest message [bytes]."""

_MOST = 2**53
_KEYS = {"nonce", "sequence", "pressed", "speed", "mode"}


class GarbageError(ValueError):
    """A message that is not understood."""


@dataclasses.dataclass(frozen=True)
class PageMessage:
    """One message of a page that may hold.

    Attributes
    ----------
    nonce : str
        The newest that it has heard.
    sequence : int
        Its own count; must increase.
    pressed : bool
        Whether its button is held.
    speed : float
        Share of the nominal speed, 0..1.
    mode : Mode
        What for.
    """

    nonce: str
    sequence: int
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
    fields = _object(data)
    if fields.keys() != _KEYS:
        raise GarbageError("other keys")
    nonce, sequence, pressed = fields["nonce"], fields["sequence"], fields["pressed"]
    speed, mode = fields["speed"], fields["mode"]
    if not isinstance(nonce, str) or not isinstance(pressed, bool) or not isinstance(mode, str):
        raise GarbageError("other types")
    if isinstance(sequence, bool) or not isinstance(sequence, int) or not 0 <= sequence < _MOST:
        raise GarbageError("no sequence number")
    if isinstance(speed, bool) or not isinstance(speed, (int, float)) or not 0.0 <= speed <= 1.0:
        raise GarbageError("no speed within 0..1")
    try:
        return PageMessage(nonce, sequence, pressed, float(speed), Mode(mode))
    except ValueError as error:
        raise GarbageError("unknown mode") from error


def read_token(data: str | bytes) -> str:
    """Read a page's first message: the token, which may be empty.

    Raises
    ------
    GarbageError
        If it is not exactly that.
    """
    fields = _object(data)
    token = fields.get("token")
    if fields.keys() != {"token"} or not isinstance(token, str):
        raise GarbageError("no token")
    return token


def _object(data: str | bytes) -> dict[str, Any]:
    if not isinstance(data, str) or len(data) > LONGEST:
        raise GarbageError("no short text")
    try:
        found = json.loads(data, object_pairs_hook=_once)
    except (ValueError, RecursionError) as error:
        raise GarbageError("no JSON") from error
    if not isinstance(found, dict):
        raise GarbageError("no object")
    return found


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise GarbageError("a key twice")
    return found
