"""Compiled inner loops: numba behind one typed decorator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile a function of numbers and arrays at its first call; the result is kept on disk.

    Divisions follow IEEE 754, as numpy's do; nothing is reordered, so that results do not depend
    on how many elements a call has.

    Parameters
    ----------
    function : callable
        What to compile; it must be one that numba's nopython mode understands.

    Returns
    -------
    callable
        The same, compiled.
    """
    return cast(Function, numba.njit(cache=True, error_model="numpy")(function))
