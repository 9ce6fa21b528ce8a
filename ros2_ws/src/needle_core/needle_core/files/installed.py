"""Places of the workspace's executables and files, as `ros2 run` finds them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from needle_core.errors import UserError


def find_executable(package: str, executable: str) -> str:
    """Return the path of a package's executable.

    Raises
    ------
    UserError
        If the environment has no such executable.
    """
    for prefix in _prefixes():
        path = prefix / "lib" / package / executable
        if os.access(path, os.X_OK):
            return str(path)
    raise UserError(_advice(f"{package} {executable}"))


def find_shared(package: str, file: str) -> Path:
    """Return the path of a file in a package's share directory.

    Raises
    ------
    UserError
        If the environment has no such file.
    """
    for prefix in _prefixes():
        path = prefix / "share" / package / file
        if path.is_file():
            return path
    raise UserError(_advice(f"{package}'s {file}"))


def _prefixes() -> Iterator[Path]:
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if prefix:
            yield Path(prefix)


def _advice(what: str) -> str:
    return f"{what} is not installed: run scripts/setup, then `source scripts/env.sh`"
