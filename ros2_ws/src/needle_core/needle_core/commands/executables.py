"""Entry points: what a package's executables do before and after their modules' `main`.

Loading ROS, numerical code and image processing takes up to seconds, and a signal may come then,
too. Hence nothing is imported here that takes time, and modules are given by name.
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
    """Return the entry point of a node: a signal while it is loaded ends it with exit code 0.

    Parameters
    ----------
    module : str
        Full name of a module whose `main` takes nothing and returns the exit code.
    """

    def enter() -> NoReturn:
        ExitOnSignal(_EXIT_DONE)
        use_fast_dds()
        code: int = loaded(module).main()
        # No way back through the interpreter: what DDS and numerical code left there has its own
        # ideas of an end, and a signal finds no handler any more.
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()
        ctypes.CDLL(None).fflush(None)
        os._exit(code)

    return enter


def command(module: str) -> Callable[[], NoReturn]:
    """Return the entry point of a command: a signal while it is loaded is exit code 130.

    Parameters
    ----------
    module : str
        Full name of a module whose `main` takes nothing and returns the exit code.
    """

    def enter() -> NoReturn:
        ExitOnSignal(_EXIT_INTERRUPTED)
        use_fast_dds()
        sys.exit(loaded(module).main())

    return enter


def loaded(module: str) -> ModuleType:
    """Return a module, imported with all that it needs.

    What is made meanwhile is there to stay: to look for garbage in it would take a tenth of the
    time now, and every later search would go through all of it again.
    """
    gc.disable()
    try:
        return importlib.import_module(module)
    finally:
        gc.freeze()
        gc.enable()
