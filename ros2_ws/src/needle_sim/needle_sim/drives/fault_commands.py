"""Faults on command: a line of words, and what it does to the bus."""

from __future__ import annotations

import enum

from needle_core.errors import UserError
from needle_sim.drives.emulated_bus import EmulatedBus

AXES = ("insertion", "rotation")
COMMANDS = """\
cut_bus             frames get lost both ways; the adapter stays
unplug              the adapter disappears
stall AXIS          the motor is blocked
reboot AXIS         the drive loses its power for a moment
emcy AXIS CODE      the drive has a fault of that error code, such as 0x5530
hang AXIS           the drive's processor hangs: silent, the motor ends at its set-point
restore             end of cut_bus, unplug, stall and hang; AXIS is insertion or rotation"""
# Command -> how many words follow.
_WORDS = {
    "cut_bus": 0,
    "unplug": 0,
    "stall": 1,
    "reboot": 1,
    "emcy": 2,
    "hang": 1,
    "restore": 0,
}


class PlugOrder(enum.Enum):
    """Effects of a command on the adapter."""

    OUT = "out"
    IN = "in"


def obey(line: str, bus: EmulatedBus, now: float) -> PlugOrder | None:
    """Carry out one command at steady time `now` [s].

    Parameters
    ----------
    line : str
        One of `COMMANDS`.
    bus : EmulatedBus
        What it happens to.
    now : float
        Steady time [s].

    Returns
    -------
    PlugOrder or None
        What is left to do to the adapter.

    Raises
    ------
    UserError
        A line that is no command.
    """
    name, *words = line.split()
    if name not in _WORDS:
        raise UserError(f"{line!r} is no command; there are\n{COMMANDS}")
    if len(words) != _WORDS[name]:
        raise UserError(f"{line!r}: {name} takes {_WORDS[name]} words, not {len(words)}")
    axis = words[0] if words else ""
    if words and axis not in AXES:
        raise UserError(f"{line!r}: {name} wants an axis, {' or '.join(AXES)}")
    if name == "emcy":
        bus.emergency(axis, _error_code(line, words[1]))
    elif name == "stall":
        bus.stall(axis)
    elif name == "reboot":
        bus.reboot(axis, now)
    elif name == "hang":
        bus.hang(axis)
    elif name == "cut_bus":
        bus.is_cut = True
    elif name == "unplug":
        return PlugOrder.OUT
    else:
        bus.restore(now)
        return PlugOrder.IN
    return None


def _error_code(line: str, word: str) -> int:
    try:
        code = int(word, 0)
    except ValueError:
        raise UserError(f"{line!r}: {word!r} is no error code, such as 0x5530") from None
    if not 1 <= code <= 0xFFFF:
        raise UserError(f"{line!r}: the error code must be within 1..0xFFFF")
    return code
