"""The exceptions a user of the rig can meet, each with the value and the bound in it."""

from __future__ import annotations


class UserError(Exception):
    """A bad argument, file or set-up that one line explains; commands exit with code 2."""


class OutOfBoundsError(UserError, ValueError):
    """A value outside its bounds.

    Parameters
    ----------
    name : str
        What the value is called where the user wrote it.
    value : float
        The offending value, in `unit`.
    lower, upper : float
        The inclusive bounds, in `unit`.
    unit : str
        The unit of all three ("-" where there is none).
    """

    def __init__(self, name: str, value: float, lower: float, upper: float, unit: str) -> None:
        sign = "" if unit == "-" else f" {unit}"
        said = f"{name} = {_said(value)}{sign}"
        super().__init__(f"{said} is outside [{_said(lower)}, {_said(upper)}]{sign}")
        self.name = name
        self.value = value
        self.lower = lower
        self.upper = upper
        self.unit = unit


def _said(value: float) -> str:
    """Return a value as a person writes it: 2147483647 and not 2.14748e+09."""
    whole = float(value).is_integer() and abs(value) < 1e12
    return f"{value:.0f}" if whole else f"{value:g}"
