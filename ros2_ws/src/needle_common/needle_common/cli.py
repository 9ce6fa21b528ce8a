"""Exit codes, one-line errors and the flat JSON result of every command line."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from needle_common.errors import UserError

EXIT_DONE = 0
EXIT_MISSED = 1
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130

JsonValue = str | int | float | bool | None


def run_command(command: Callable[[], int]) -> int:
    """Run a command and turn what a user can cause into an exit code and one line.

    Parameters
    ----------
    command : callable
        Does the work and returns its exit code.

    Returns
    -------
    int
        The command's own code, 2 after a `UserError`, 130 after an interrupt.
    """
    try:
        code = command()
        # a reader that has left shows here, and not when the interpreter ends
        sys.stdout.flush()
        return code
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # The reader of our output left (`| head`): not an error, but nothing more can be printed.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_DONE


def finite_or_none(value: JsonValue) -> JsonValue:
    """Return `value`, or None for a float that JSON cannot carry (NaN, infinities)."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_json(path: Path, values: Mapping[str, JsonValue]) -> None:
    """Write a flat JSON object; a figure that does not exist becomes null, never NaN.

    Parameters
    ----------
    path : Path
        File to write; its folder must exist.
    values : mapping
        Flat key to value; keys end in their unit.

    Raises
    ------
    UserError
        If the file cannot be written.
    """
    text = json.dumps({key: finite_or_none(value) for key, value in values.items()}, indent=2)
    try:
        path.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error
