"""Entry points of a package's executables: signals, environment and import before `main`.

Loading ROS, numerical code and image processing may take seconds, and a signal may arrive in the
meantime. Therefore this module imports nothing slow, and modules are given by name.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import os
import sys
from collections.abc import Callable
from types import ModuleType
from typing import NoReturn

from needle_core.process.discovery import use_fast_dds
from needle_core.process.shutdown import ExitOnSignal

_EXIT_DONE = 0
_EXIT_INTERRUPTED = 130


def node(module: str) -> Callable[[], NoReturn]:
    """Return the entry point of a node; a signal during loading means exit code 0.

    Parameters
    ----------
    module : str
        Full name of a module; its `main` has no arguments and returns the exit code.
    """

    def enter() -> NoReturn:
        ExitOnSignal(_EXIT_DONE)
        use_fast_dds()
        code: int = load(module).main()
        # Skip the interpreter's shutdown: clean-up of DDS and numerical libraries may hang or
        # crash there, and signals are no longer handled.
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()
        ctypes.CDLL(None).fflush(None)
        os._exit(code)

    return enter


def command(module: str) -> Callable[[], NoReturn]:
    """Return the entry point of a command; a signal during loading means exit code 130.

    Parameters
    ----------
    module : str
        Full name of a module; its `main` has no arguments and returns the exit code.
    """

    def enter() -> NoReturn:
        ExitOnSignal(_EXIT_INTERRUPTED)
        use_fast_dds()
        sys.exit(load(module).main())

    return enter


def load(module: str) -> ModuleType:
    """Import a module with garbage collection switched off, and return it.

    The imported objects stay alive. Collecting them would take a tenth of the loading time, and
    without freezing them every later collection would traverse them again.
    """
    gc.disable()
    try:
        return importlib.import_module(module)
    finally:
        gc.freeze()
        gc.enable()
