"""Functions compiled by numba at their first call and kept on disk, with their types intact."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])
_COMPILED = re.compile(rb"^(@compiled|@inlined|@parallel|# Read by compiled code\.)$", re.MULTILINE)


def compiled(function: Function) -> Function:
    """Compile a function of numbers and arrays at its first call; a decorator.

    All follows IEEE 754, as Python's floats do: nothing is reordered, and a product and a sum stay
    two roundings. So results depend neither on how many elements a call has nor on what the
    compiler put into the caller, which is not the same where a function is compiled and where it
    comes from the cache.

    What was compiled is kept in the user's cache, in a folder named after all files of the
    function's package, from its root down, that hold compiled functions or are marked as read by
    such: numba itself looks at the file of the called function only, and would go on using old code
    of what that function calls in another file.

    Parameters
    ----------
    function : callable
        What to compile; it must be one that numba's nopython mode understands.

    Returns
    -------
    callable
        The same, compiled.
    """
    return _compile(function)


def parallel(function: Function) -> Function:
    """Compile like `compiled` what loops with `numba.prange` over what does not share anything.

    The rounds are divided among NUMBA_NUM_THREADS threads; each comes out the same in any of them.
    """
    # Threads that sleep between two calls, and bear a fork.
    numba.config.THREADING_LAYER = "workqueue"
    return _compile(function, parallel=True)


def inlined(function: Function) -> Function:
    """Compile like `compiled` what loops of other compiled functions call; a decorator.

    Its code becomes part of the caller's: only so can a loop be done for several elements at once.
    """
    return _compile(function, forceinline=True)


def _compile(function: Function, **options: bool) -> Function:
    folder = _cache_directory(_package_root(Path(function.__code__.co_filename)))
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = folder
    try:
        result = numba.njit(
            cache=bool(folder),
            error_model="numpy",
            **options,
        )(function)
    finally:
        numba.config.CACHE_DIR = before
    return cast(Function, result)


def _package_root(module: Path) -> Path:
    """Return the topmost folder of the package that a module's file is in."""
    folder = module.parent
    while (folder.parent / "__init__.py").exists():
        folder = folder.parent
    return folder


@functools.cache
def _cache_directory(package: Path) -> str:
    """Return a folder for this state of a package's sources, or "" where none can be made."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in [Path(__file__), *sorted(package.rglob("*.py"))]:
        source = path.read_bytes()
        if _COMPILED.search(source) or path == Path(__file__):
            digest.update(source)
    for place in _places():
        folder = place / "needle_steering" / package.name / digest.hexdigest()[:16]
        with contextlib.suppress(OSError):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if os.access(folder, os.W_OK | os.X_OK):
                return str(folder)
    return ""


def _places() -> list[Path]:
    """Return where a cache may be, the first choice first."""
    named = (os.environ.get(name, "") for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"))
    places = [Path(place) for place in named if place]
    # HOME, or else the home that the password database has; without either there is none.
    with contextlib.suppress(RuntimeError):
        places.append(Path.home() / ".cache")
    return [place for place in places if place.is_absolute()]
