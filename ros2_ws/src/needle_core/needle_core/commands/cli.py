"""Exit codes, one-line errors and the flat JSON result of every command line."""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path

from needle_core.errors import UserError
from needle_core.process.shutdown import interruptible

EXIT_DONE = 0
EXIT_MISSED = 1
EXIT_BAD_INPUT = 2
EXIT_INTERNAL_ERROR = 3
EXIT_INTERRUPTED = 130
# In place of a file's name.
STANDARD_OUTPUT = "-"

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
        The command's own code, 2 after a `UserError`, 3 after any other exception, 130 after
        SIGINT, SIGTERM or SIGHUP.
    """
    try:
        with interruptible(), contextlib.redirect_stdout(sys.stdout):
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
    except Exception as error:  # noqa: BLE001
        return internal_error(error)


def internal_error(error: Exception) -> int:
    """Say in one line what this software did wrong and where; return the exit code for it.

    In Python's development mode (PYTHONDEVMODE=1) the traceback comes before it.
    """
    if sys.flags.dev_mode:
        traceback.print_exception(error)
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    words = " ".join(f"{type(error).__name__}: {error}".split())
    print(
        f"error: internal error, please report it: {words}{where}; PYTHONDEVMODE=1 shows more",
        file=sys.stderr,
    )
    return EXIT_INTERNAL_ERROR


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
        File to write; its folder must exist. `-` is standard output.
    values : mapping
        Flat key to value; keys end in their unit.

    Raises
    ------
    UserError
        If the file cannot be written.
    """
    text = json.dumps({key: finite_or_none(value) for key, value in values.items()}, indent=2)
    if str(path) == STANDARD_OUTPUT:
        print(text, file=sys.__stdout__)
        return
    try:
        path.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error
