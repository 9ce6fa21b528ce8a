"""Emulated drives by name: those of this package, and those that other packages offer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.metadata import EntryPoint, entry_points

from needle_core.errors import UserError
from needle_sim.drives.emulated_drives import EmulatedDrives
from needle_sim.drives.motor import MotorSettings

GROUP = "needle_sim.drives"
"""Group of the entry points: name to a callable as `load_emulator` returns it."""
CIA402 = "cia402"
_OWN = {
    "galil": "needle_sim.drives.galil_drives:GalilDrives",
    "zaber": "needle_sim.drives.zaber_drives:ZaberDrives",
    "stepdir": "needle_sim.drives.stepdir_drives:StepdirDrives",
}


def load_emulator(name: str) -> Callable[[Mapping[str, MotorSettings], float], EmulatedDrives]:
    """Return what makes the drives of a name, from their motors and the time of power-up [s].

    Raises
    ------
    UserError
        If no package offers such drives.
    """
    own = (EntryPoint(known, place, GROUP) for known, place in _OWN.items())
    found = {entry.name: entry for entry in (*own, *entry_points(group=GROUP))}
    if name not in found:
        raise UserError(f"drives: {name!r} is unknown; known: {', '.join((CIA402, *found))}")
    loaded: Callable[[Mapping[str, MotorSettings], float], EmulatedDrives] = found[name].load()
    return loaded
