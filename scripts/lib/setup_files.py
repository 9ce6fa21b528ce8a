"""Files of scripts/setup: stamps that are complete or not there, hashes, a lock's entries."""

from __future__ import annotations

import hashlib
import re
import shlex
from pathlib import Path

from setup_errors import SetupError

# Linux cuts a script's first line off after this many bytes (127 before 5.1).
LONGEST_SHEBANG = 127


def digest(*parts: str | bytes) -> str:
    """Return a hash of the parts."""
    total = hashlib.sha256()
    for part in parts:
        total.update(part if isinstance(part, bytes) else part.encode())
        total.update(b"\0")
    return total.hexdigest()


def read(path: Path) -> str:
    """Return a file's text, or nothing where it does not exist."""
    try:
        return path.read_text("utf-8").strip()
    except (FileNotFoundError, NotADirectoryError):
        return ""


def write(path: Path, text: str) -> None:
    """Write a file in one piece: it is complete, or not there."""
    draft = path.with_name(path.name + ".new")
    draft.write_text(text + "\n", encoding="utf-8")
    draft.replace(path)


def requirement(text: str, name: str) -> str:
    """Return one package's lines of a lock."""
    found = re.search(rf"^{name}==(.*\\\n)*.*$", text, flags=re.MULTILINE)
    if found is None:
        raise SetupError(f"no {name} in the lock; renew it with scripts/lib/lock.py")
    return found.group() + "\n"


def executable(target: str, python: Path) -> str:
    """Return the script of an entry point, `module:function`, whatever the path to its Python.

    colcon's own looks for the package's metadata first: up to a tenth of a node's start.
    """
    module, _, function = target.partition(":")
    first = f"#!{python}"
    if " " in first or len(first) > LONGEST_SHEBANG:
        # sh runs the second line; to Python it is a string.
        first = f"#!/bin/sh\n'''exec' {shlex.quote(str(python))} \"$0\" \"$@\"\n'''"
    return f"""\
{first}
import sys

from {module} import {function}

if __name__ == "__main__":
    sys.exit({function}())
"""
