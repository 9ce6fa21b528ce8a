"""Command-line options: parsing, and one-line errors for invalid values."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn, overload

from needle_core.errors import UserError
from needle_core.settings.bounds import check_bounds


class CommandParser(argparse.ArgumentParser):
    """Parser that raises `UserError` for invalid arguments; options cannot be abbreviated.

    Parameters
    ----------
    name : str
        Name of the command.
    description, epilog : str
        Texts of `--help` before and after the options, printed unchanged.
    """

    def __init__(self, name: str, description: str, epilog: str) -> None:
        super().__init__(
            prog=name,
            description=description,
            epilog=epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )

    def error(self, message: str) -> NoReturn:
        """Raise the error that argparse would print before exiting."""
        raise UserError(f"{message}; see --help")


def number(name: str, text: str, lower: float, upper: float, unit: str) -> float:
    """Return the number given to an option.

    Parameters
    ----------
    name, text : str
        Name of the option, and its argument.
    lower, upper : float
        Inclusive bounds, in `unit`; infinity is valid if it is a bound.
    unit : str
        Unit of the argument, "-" for none.

    Raises
    ------
    UserError
        If it is not a number or out of bounds.
    """
    try:
        value = float(text)
    except ValueError:
        raise UserError(f"{name} {text!r} is not a number") from None
    check_bounds(name, value, lower, upper, unit, unlimited=upper == math.inf)
    return value


def whole_number(name: str, text: str, lower: int, upper: int) -> int:
    """Return the integer given to an option; arguments and errors are those of `number`."""
    try:
        value = int(text)
    except ValueError:
        raise UserError(f"{name} {text!r} is not a whole number") from None
    check_bounds(name, value, lower, upper, "-")
    return value


@overload
def output_file(name: str, text: None) -> None: ...
@overload
def output_file(name: str, text: str | Path) -> Path: ...
def output_file(name: str, text: str | Path | None) -> Path | None:
    """Return the output file given to an option; None if it was not given.

    Raises
    ------
    UserError
        If it is a folder, or its folder does not exist.
    """
    if text is None:
        return None
    path = Path(text).expanduser()
    if path.is_dir() or not path.parent.is_dir():
        raise UserError(f"{name} {text}: its folder must exist, and it must not be a folder")
    return path


_STARTS = ("--initial", "--target")


def join_signed_values(arguments: Sequence[str]) -> list[str]:
    """Join `--initial -3,2,15` to `--initial=-3,2,15`, as argparse would reject the former.

    The same applies to `--target`.
    """
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] in _STARTS and argument[1:2] in "0123456789.ni":
            joined[-1] = f"{joined[-1]}={argument}"
        else:
            joined.append(argument)
    return joined


def start(text: str, largest_x: float, largest_pitch: float) -> tuple[float, float, float]:
    """Return (x in mm, pitch and roll in degrees) of `--initial X_MM,PITCH_DEG,ROLL_DEG`.

    Raises
    ------
    UserError
        If these are not three numbers, |x| <= `largest_x`, |pitch| <= `largest_pitch`, |roll| <=
        180.
    """
    parts = text.split(",")
    if len(parts) != 3:
        raise UserError(f"--initial {text!r} is not X_MM,PITCH_DEG,ROLL_DEG, such as -3,2,15")
    return (
        number("--initial X_MM", parts[0], -largest_x, largest_x, "mm"),
        number("--initial PITCH_DEG", parts[1], -largest_pitch, largest_pitch, "deg"),
        number("--initial ROLL_DEG", parts[2], -180.0, 180.0, "deg"),
    )
