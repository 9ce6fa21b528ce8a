"""Tick, a made-up two-axis drive on a serial line, as a backend of device_driver.

A line is a letter and numbers; `a` is the axis, 0 or 1:

    I             -> I name                        identity
    Z a           -> Z                             clears faults and marks the drive as set up
    E a on                                         switches the motor on (1) or off (0)
    G a pos speed                                  moves to `pos` [counts] at `speed` [counts/s]
    H a                                            halts
    Q n           -> Q n pos flags pos flags       state of both axes, for request number n
"""

from __future__ import annotations

import dataclasses
import math
import re
from typing import ClassVar

from needle_core.settings.parameter_fields import fixed_parameter
from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.polled.drive_protocol import DriveProtocol, DriveReply
from needle_device_driver.polled.polled_drives import polled_backend
from needle_device_driver.procedure import Procedure

AXES = {"insertion": 0, "rotation": 1}
# A line with a flipped bit must not raise.
STATE = re.compile(r"Q \d+( -?\d+ \d+){2}\s*")
MOVING, ON, OUTER, INNER, FAULT, SET_UP = 1, 2, 4, 8, 16, 32


@dataclasses.dataclass(frozen=True)
class TickSettings:
    """Parameters of the drive; their names begin with its own."""

    tick_address: str = fixed_parameter(
        "/dev/ttyUSB0", "-", "Serial port of the Tick drive, or host:port."
    )


class TickProtocol(DriveProtocol):
    """The lines of the drive; it ends each move at its target and has no watchdog."""

    capabilities: ClassVar[Capabilities] = Capabilities(
        watchdog=math.inf,
        longest_order=0.02,
        response_time=0.02,
        encoder=True,
        switches=True,
        limits=False,
        identity=True,
        exclusive=True,
    )

    def identify(self) -> Procedure[str]:
        """Return the name of the drive."""
        return (yield from self.ask("I", b"I\n"))

    def set_up(self, axis: str) -> Procedure[None]:
        """Switch off, and mark the drive as set up."""
        self.power(axis, False)
        yield from self.ask("Z", f"Z {AXES[axis]}\n".encode())

    def clear_fault(self, axis: str) -> Procedure[None]:
        """Clear faults."""
        yield from self.ask("Z", f"Z {AXES[axis]}\n".encode())

    def release(self, axis: str) -> Procedure[None]:
        """Switch off."""
        self.power(axis, False)
        yield from ()

    def power(self, axis: str, on: bool) -> None:
        """Switch the motor on or off."""
        self.link.send(f"E {AXES[axis]} {int(on)}\n".encode())

    def move_to(self, axis: str, position: int, speed: int) -> None:
        """Move to a set-point."""
        self.link.send(f"G {AXES[axis]} {position} {speed}\n".encode())

    def stop(self, axis: str) -> None:
        """Halt."""
        self.link.send(f"H {AXES[axis]}\n".encode())

    def request(self, number: int) -> None:
        """Ask for the state of both axes."""
        self.link.send(f"Q {number}\n".encode())

    def on_line(self, line: str) -> None:
        """Handle an answer."""
        words = line.split()
        if words and words[0] in ("I", "Z"):
            self.answer(words[0], " ".join(words[1:]))
        elif STATE.fullmatch(line):
            number, *state = map(int, words[1:])
            self.on_status(
                number, {name: _reply(*state[2 * AXES[name] :][:2]) for name in self.axes}
            )


def _reply(position: int, flags: int) -> DriveReply:
    return DriveReply(
        position,
        moving=bool(flags & MOVING),
        powered=bool(flags & ON),
        home_switch=bool(flags & OUTER),
        inner_switch=bool(flags & INNER),
        fault="reports a fault" if flags & FAULT else "",
        rebooted=not flags & SET_UP,
    )


BACKEND = polled_backend(
    "tick", TickSettings, TickProtocol, address=lambda parameters: parameters.tick_address
)
