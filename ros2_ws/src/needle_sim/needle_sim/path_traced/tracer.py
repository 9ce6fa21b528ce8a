"""Mitsuba 3, which is an extra: loaded when it is asked for, and missed in one line."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any, NamedTuple

from needle_core.errors import UserError

VARIANT = "llvm_ad_mono"
"""Grey light, compiled by LLVM: on one core 5 times as many paths a second as scalar_rgb."""

MM = 1e3
"""Scenes are in mm: the tracer's guard against self-intersection is a tenth of a unit near 1 m."""

_LIBRARY_VARIABLE = "DRJIT_LIBLLVM_PATH"
# Older ones end the process: they cannot compile IEEE 754's minimum for x86.
_OLDEST_LLVM = 17
_LIBRARY_FOLDERS = ("/usr/lib/x86_64-linux-gnu", "/usr/lib64", "/usr/lib")
_LIBRARY_NAME = re.compile(r"libLLVM(?:-|\.so\.)(\d+)[\d.]*(?:\.so(?:\.1)?)?")
_HINT = "docs/dependencies.md says how to install it"


class Mitsuba(NamedTuple):
    """The tracer's two modules, which have no types.

    Attributes
    ----------
    mi, dr : module
        `mitsuba`, its variant chosen, and `drjit`, its arrays.
    """

    mi: Any
    dr: Any


def load_mitsuba() -> Mitsuba:
    """Return the tracer.

    LLVM is taken from DRJIT_LIBLLVM_PATH, else the newest one among the system's libraries.

    Raises
    ------
    UserError
        If Mitsuba or an LLVM that is new enough is missing.
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
            f"{os.environ[_LIBRARY_VARIABLE]} is no LLVM library that can be used; {_HINT}"
        ) from None
    if version[0] < _OLDEST_LLVM:
        raise UserError(
            f"{os.environ[_LIBRARY_VARIABLE]} is LLVM {version[0]}, "
            f"older than {_OLDEST_LLVM}; {_HINT}"
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
    if version < _OLDEST_LLVM:
        raise UserError(
            f"renderer path_traced needs LLVM {_OLDEST_LLVM} or newer, which is not installed; "
            + _HINT
        )
    return path
