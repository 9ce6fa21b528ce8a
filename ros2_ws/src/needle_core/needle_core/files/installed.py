"""Paths of installed executables and files: in a checkout, from pip, or from colcon."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from pathlib import Path

from needle_core.errors import UserError


def find_executable(package: str, executable: str) -> str:
    """Return the path of an executable of a package.

    Raises
    ------
    UserError
        If the environment has no such executable.
    """
    candidates = [Path(sys.executable).parent, *(one / "lib" / package for one in _prefixes())]
    for folder in candidates:
        if os.access(folder / executable, os.X_OK):
            return str(folder / executable)
    raise UserError(_advice(f"{package} {executable}"))


def find_shared_file(package: str, file: str) -> Path:
    """Return the path of a file in a package's share folder, such as a configuration.

    Raises
    ------
    UserError
        If the environment has no such file.
    """
    candidates = [prefix / "share" / package for prefix in (*_prefixes(), Path(sys.prefix))]
    module = find_spec(package)
    if module is not None and module.origin is not None:
        # In a checkout, edits take effect without a new installation.
        candidates.insert(0, Path(module.origin).parents[1])
    for folder in candidates:
        if (folder / file).is_file():
            return folder / file
    raise UserError(_advice(f"{package}'s {file}"))


def _prefixes() -> list[Path]:
    return [Path(one) for one in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if one]


def _advice(what: str) -> str:
    return f"{what} is not installed: run scripts/setup, then `source scripts/env.sh`"
