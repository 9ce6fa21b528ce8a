"""Faults of the emulated drives on command, and their health."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_sim.drives.emulated_drives import FAULT, EmulatedDrives


def health(connections: Sequence[EmulatedDrives]) -> Diagnostic:
    """Return the states of all drives, and the faults of drives and connections."""
    states: dict[str, str] = {}
    problems = []
    for drives in connections:
        states |= drives.states()
        if drives.is_cut:
            problems.append(f"{drives.port} is cut")
    faults = [name for name, state in states.items() if state.startswith(FAULT)]
    if faults:
        problems.insert(0, f"fault of {' and '.join(faults)}")
    level = Level.WARN if problems else Level.OK
    return Diagnostic(level, ", ".join(problems) or "runs", states)


COMMANDS = """\
cut_bus             lose all data in both directions; the connection stays open
unplug              remove the CAN adapter, or close the TCP connections
stall AXIS          block the motor
reboot AXIS         interrupt the drive's power
emcy AXIS CODE      put the drive into a fault with this error code, such as 0x5530
hang AXIS           hang the drive's processor: it is silent, the motor ends at its set-point
restore             end cut_bus, unplug, stall and hang; AXIS is insertion or rotation"""


def execute_command(line: str, connections: Sequence[EmulatedDrives], now: float) -> bool | None:
    """Execute a fault command at steady time `now` [s].

    Parameters
    ----------
    line : str
        One of `COMMANDS`.
    connections : sequence of EmulatedDrives
        All drives.
    now : float
        Steady time [s].

    Returns
    -------
    bool or None
        Whether to plug the adapters in or out; None: neither.

    Raises
    ------
    UserError
        If the line is not a valid command.
    """
    drives_of = {axis: drives for drives in connections for axis in drives.motors}
    match line.split():
        case ["cut_bus"]:
            for drives in drives_of.values():
                drives.is_cut = True
        case ["unplug"]:
            return False
        case ["restore"]:
            for drives in connections:
                drives.restore(now)
            return True
        case ["stall" | "hang" as fault, axis] if axis in drives_of:
            getattr(drives_of[axis], fault)(axis)
        case ["reboot", axis] if axis in drives_of:
            drives_of[axis].reboot(axis, now)
        case ["emcy", axis, text] if axis in drives_of and (code := _error_code(text)):
            drives_of[axis].fail(axis, code)
        case _:
            raise UserError(f"{line!r} is not a command; known:\n{COMMANDS}")
    return None


def _error_code(text: str) -> int:
    """Return an error code of 16 bits; 0 for any other text."""
    with contextlib.suppress(ValueError):
        code = int(text, 0)
        return code if 1 <= code <= 0xFFFF else 0
    return 0
