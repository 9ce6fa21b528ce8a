"""Components of users, by module and name."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

from needle_core.component import Component
from needle_core.errors import UserError


def own_component(given: str) -> Component:
    """Return a component made of `MODULE:NAME`; its class takes no arguments.

    Modules of the current folder are found, too.

    Raises
    ------
    UserError
        If there is no such module or name in it, or it makes no component.
    """
    module_name, _, name = given.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    try:
        make = getattr(importlib.import_module(module_name), name)
        component = make()
    except (ImportError, AttributeError, TypeError) as error:
        raise UserError(f"--component {given}: {error}") from error
    finally:
        sys.path.pop(0)
    if not isinstance(component, Component):
        raise UserError(f"--component {given}: makes a {type(component).__name__}, no Component")
    return component
