"""Exceptions for mistakes of the user; the message contains the value and its bound."""

from __future__ import annotations

import difflib
from collections.abc import Collection


class UserError(Exception):
    """Bad argument, file or set-up, explained in one line; commands exit with code 2."""


class OutOfBoundsError(UserError, ValueError):
    """Value outside its bounds.

    Parameters
    ----------
    name : str
        Name of the value as the user wrote it.
    value : float
        The value, in `unit`.
    lower, upper : float
        The inclusive bounds, in `unit`.
    unit : str
        Unit of all three; "-" for none.
    """

    def __init__(self, name: str, value: float, lower: float, upper: float, unit: str) -> None:
        sign = "" if unit == "-" else f" {unit}"
        bounds = f"[{_format(lower)}, {_format(upper)}]"
        super().__init__(f"{name} = {_format(value)}{sign} is outside {bounds}{sign}")


def _format(value: float) -> str:
    """Format a whole number in full, such as 2147483647, and any other with six digits."""
    whole = float(value).is_integer() and abs(value) < 1e12
    return f"{value:.0f}" if whole else f"{value:g}"


def did_you_mean(name: str, known: Collection[str]) -> str:
    """Return a hint: the known name most similar to a misspelt one, or all known names."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"did you mean '{close[0]}'?" if close else f"known: {', '.join(sorted(known))}"
