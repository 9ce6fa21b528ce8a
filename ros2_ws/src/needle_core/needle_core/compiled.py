"""Decorators that compile functions with numba at their first call and cache them on disk."""

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
    """Decorate a function of numbers and arrays so that its first call compiles it.

    The code follows IEEE 754 like Python's floats: no reordering, no fused multiply-add. Therefore
    the results depend neither on the number of elements of a call nor on inlining, which differs
    between freshly compiled and cached functions.

    The cache folder is named after a hash of all files of the package that contain compiled
    functions or the marker comment below. numba itself checks only the file of the called function,
    so it would reuse stale code of functions in other files.

    Parameters
    ----------
    function : callable
        Function in the subset of numba's nopython mode.

    Returns
    -------
    callable
        The compiled function.
    """
    return _compile(function)


def parallel(function: Function) -> Function:
    """Compile, like `compiled`, a function that uses `numba.prange` to loop over independent items.

    NUMBA_NUM_THREADS threads share the iterations; the results do not depend on their number.
    """
    # This threading layer sleeps between calls and survives a fork.
    numba.config.THREADING_LAYER = "workqueue"
    return _compile(function, parallel=True)


def inlined(function: Function) -> Function:
    """Compile, like `compiled`, a function that other compiled functions call in loops.

    Its code is inlined into the caller, so that the compiler can vectorise the loop.
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
            # Nothing calls the functions from C: compile a tenth faster.
            no_cfunc_wrapper=True,
            **options,
        )(function)
    finally:
        numba.config.CACHE_DIR = before
    return cast(Function, result)


def _package_root(module: Path) -> Path:
    """Return the root folder of the package that contains a module."""
    folder = module.parent
    while (folder.parent / "__init__.py").exists():
        folder = folder.parent
    return folder


@functools.cache
def _cache_directory(package: Path) -> str:
    """Return the cache folder for the current sources of a package; "" if none is writable."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in [Path(__file__), *sorted(package.rglob("*.py"))]:
        source = path.read_bytes()
        if _COMPILED.search(source) or path == Path(__file__):
            digest.update(source)
    for root in _cache_roots():
        folder = root / "needle_steering" / package.name / digest.hexdigest()[:16]
        with contextlib.suppress(OSError):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if os.access(folder, os.W_OK | os.X_OK):
                return str(folder)
    return ""


def _cache_roots() -> list[Path]:
    """Return the candidate cache folders, best first."""
    named = (os.environ.get(name, "") for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"))
    roots = [Path(root) for root in named if root]
    # Path.home() fails if neither HOME nor the password database names a home.
    with contextlib.suppress(RuntimeError):
        roots.append(Path.home() / ".cache")
    return [root for root in roots if root.is_absolute()]
