"""Kinds of drives that device_driver supports, each an entry point of a package."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from needle_core.component import RealPort
from needle_core.errors import UserError
from needle_device_driver.axes.axis_settings import AxisSettings
from needle_device_driver.axes.drives import Drives

GROUP = "needle_device_driver.axes"
"""Group of the entry points; their names are the values of `insertion_drive`, `rotation_drive`."""
HAND = "hand"
"""Drive of an axis that is moved by hand and only measured."""
_OWN = {
    "cia402": "needle_device_driver.cia402.backend:BACKEND",
    "stepdir": "needle_device_driver.backends.stepdir:BACKEND",
    "zaber": "needle_device_driver.backends.zaber:BACKEND",
    HAND: "needle_device_driver.cia402.backend:BACKEND",
    "galil": "needle_device_driver.backends.galil:BACKEND",
}
_PAGE = "docs/own_drives.md"


@dataclasses.dataclass(frozen=True, eq=False)
class Backend:
    """A kind of drive: the object of an entry point.

    Attributes
    ----------
    port : str
        Name of the component's port to the drives.
    settings : type
        Dataclass of the parameters it adds to device_driver (`fixed_parameter` fields).
    make : callable
        Returns its `Drives` from all parameters of device_driver and the settings of its axes.
    open_port : callable
        Returns its port from all parameters of device_driver.
    check : callable
        Raises `UserError` if the parameters contradict each other.
    """

    port: str
    settings: type[Any]
    make: Callable[[Any, Mapping[str, AxisSettings]], Drives]
    open_port: Callable[[Any], RealPort]
    check: Callable[[Any], None] = lambda _: None


def backends() -> dict[str, Backend]:
    """Return all installed backends by name.

    Raises
    ------
    UserError
        If a backend cannot be loaded, or two have the same name.
    """
    own = [EntryPoint(name, value, GROUP) for name, value in _OWN.items()]
    loaded: dict[str, Backend] = {}
    for entry in (*own, *entry_points(group=GROUP)):
        try:
            backend = entry.load()
        # A third-party package may raise any exception.
        except Exception as error:
            raise UserError(f"drive {entry.name!r} ({entry.value}): {error}; {_PAGE}") from error
        if not isinstance(backend, Backend):
            raise UserError(f"drive {entry.name!r}: {entry.value} is not a Backend; {_PAGE}")
        if loaded.setdefault(entry.name, backend) is not backend:
            raise UserError(f"two packages provide the drive {entry.name!r}: remove one")
    return loaded


def parameters_of(loaded: Iterable[Backend]) -> tuple[type[Any], ...]:
    """Return the parameter dataclasses of the backends, each once.

    Raises
    ------
    UserError
        If two backends have a parameter with the same name.
    """
    kinds = tuple(dict.fromkeys(backend.settings for backend in loaded))
    owners: dict[str, type[Any]] = {}
    for kind in kinds:
        for field in dataclasses.fields(kind):
            if owners.setdefault(field.name, kind) is not kind:
                raise UserError(
                    f"{kind.__name__} and {owners[field.name].__name__} both have the parameter "
                    f"{field.name}: its name must begin with that of the drive"
                )
    return kinds
