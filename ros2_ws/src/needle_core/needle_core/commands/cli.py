"""Exit codes, one-line errors and flat JSON results of all commands."""

from __future__ import annotations

import json
import math
import os
import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path

from needle_core.errors import UserError
from needle_core.files.file_access import write_text
from needle_core.process.shutdown import interruptible

EXIT_DONE = 0
EXIT_MISSED = 1
EXIT_BAD_INPUT = 2
EXIT_INTERNAL_ERROR = 3
EXIT_INTERRUPTED = 130

JsonValue = str | int | float | bool | None


def run_command(command: Callable[[], int]) -> int:
    """Run a command; turn every error into an exit code and one line.

    Parameters
    ----------
    command : callable
        The command; returns its exit code.

    Returns
    -------
    int
        The command's own code, 2 after a `UserError`, 3 after any other exception, 130 after
        SIGINT, SIGTERM or SIGHUP.
    """
    try:
        with interruptible():
            code = command()
            # A closed pipe raises here instead of at the interpreter's exit.
            sys.stdout.flush()
        return code
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # The reader closed the pipe (`| head`): not an error, but printing must stop.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_DONE
    except Exception as error:  # noqa: BLE001
        return internal_error(error)


def internal_error(error: Exception) -> int:
    """Print an internal error and its location in one line; return its exit code.

    Python's development mode (PYTHONDEVMODE=1) prints the traceback as well.
    """
    if sys.flags.dev_mode:
        traceback.print_exception(error)
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    message = " ".join(f"{type(error).__name__}: {error}".split())
    print(
        f"error: internal error, please report it: {message}{where}; PYTHONDEVMODE=1 shows more",
        file=sys.stderr,
    )
    return EXIT_INTERNAL_ERROR


def finite_or_none(value: JsonValue) -> JsonValue:
    """Return `value`, or None for a float that JSON does not support (NaN, infinities)."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_json(path: Path | None, values: Mapping[str, JsonValue]) -> None:
    """Write a flat JSON object; missing values become null, never NaN.

    Parameters
    ----------
    path : Path or None
        File to write, in an existing folder; None if none was given, then nothing is written.
    values : mapping
        Key to value; keys end in their unit.

    Raises
    ------
    UserError
        If the file cannot be written.
    """
    if path is None:
        return
    text = json.dumps({key: finite_or_none(value) for key, value in values.items()}, indent=2)
    write_text(path, text + "\n")
