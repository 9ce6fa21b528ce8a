"""Loading of Mitsuba 3, an optional dependency; a missing one is reported in one line."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any, NamedTuple

from needle_core.errors import UserError

VARIANT = "llvm_ad_mono"
"""Grey light, compiled by LLVM: 5 times as fast as scalar_rgb on one core."""

MM = 1e3
"""Scale of scenes, which are in mm: near 1 m the tracer's self-intersection guard is 0.1 units."""

_LIBRARY_VARIABLE = "DRJIT_LIBLLVM_PATH"
# Older versions abort the process: they cannot compile the IEEE 754 minimum for x86.
_MIN_LLVM = 17
_LIBRARY_FOLDERS = ("/usr/lib/x86_64-linux-gnu", "/usr/lib64", "/usr/lib")
_LIBRARY_NAME = re.compile(r"libLLVM(?:-|\.so\.)(\d+)[\d.]*(?:\.so(?:\.1)?)?")
_HINT = "see docs/dependencies.md"


class Mitsuba(NamedTuple):
    """Modules of the tracer, without type annotations.

    Attributes
    ----------
    mi, dr : module
        `mitsuba` with its variant set, and `drjit`, its array library.
    """

    mi: Any
    dr: Any


def load_mitsuba() -> Mitsuba:
    """Return the tracer.

    It uses the LLVM library in DRJIT_LIBLLVM_PATH, or the newest one on the system.

    Raises
    ------
    UserError
        If Mitsuba or a recent LLVM is missing.
    """
    try:
        import drjit  # noqa: PLC0415
        import mitsuba  # noqa: PLC0415
    except ImportError as error:
        raise UserError(
            f"renderer path_traced needs Mitsuba 3, which is not installed ({error}); {_HINT}"
        ) from None
    if not os.environ.get(_LIBRARY_VARIABLE):
        os.environ[_LIBRARY_VARIABLE] = str(_newest_llvm())
    try:
        mitsuba.set_variant(VARIANT)
        version = drjit.detail.llvm_version()
    except ImportError:
        raise UserError(
            f"{os.environ[_LIBRARY_VARIABLE]} is not a usable LLVM library; {_HINT}"
        ) from None
    if version[0] < _MIN_LLVM:
        raise UserError(
            f"{os.environ[_LIBRARY_VARIABLE]} is LLVM {version[0]}, older than {_MIN_LLVM}; {_HINT}"
        )
    return Mitsuba(mitsuba, drjit)


def _newest_llvm() -> Path:
    found = [
        (int(match[1]), path)
        for folder in _LIBRARY_FOLDERS
        for path in sorted(Path(folder).glob("libLLVM*"))
        if (match := _LIBRARY_NAME.fullmatch(path.name)) is not None
    ]
    version, path = max(found, default=(0, Path()))
    if version < _MIN_LLVM:
        raise UserError(
            f"renderer path_traced needs LLVM {_MIN_LLVM} or newer, which is not installed; "
            + _HINT
        )
    return path
