"""Emulated step/direction board for two stepper motors without encoders."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from functools import reduce

from needle_sim.drives.motor import MotorSettings
from needle_sim.drives.text_drives import TextDrive, TextDrives

MAX_RATE = 100_000
"""Largest step rate of an axis [1/s]: a 32-bit board."""
SILENT, LINE_LOST = 1, 2
"""Faults: the dead-man has expired; a line number does not follow the last one."""
_AXES = ("insertion", "rotation")
_LINE = re.compile(r"\$((\d{1,3}),([A-Z])((?:,-?\d{1,10})*))\*([0-9A-F]{2})")
_ON, _MOVING, _OUTER, _INNER, _SET_UP = 1, 2, 4, 8, 16
_DEAD_MAN = 0.1


class StepdirDrive(TextDrive):
    """Stepper of one axis; the board counts the steps that it sends, even if the motor loses them.

    Attributes
    ----------
    target : float or None
        Target of the motion [steps on the motor's scale].
    speed, deceleration : float
        Speed of the motion [steps/s], and ramp of all motions [steps/s^2]; 0: not set up yet.
    outer : int
        Direction of the outer switch, 1 or -1.
    """

    def __init__(self, name: str, settings: MotorSettings) -> None:
        super().__init__(name, dataclasses.replace(settings, lag=0.0))

    def power_up(self) -> None:
        """Reset the set-up and the position."""
        super().power_up()
        self.zero = self.demand.position
        self.speed = self.deceleration = 0.0
        self.outer = -1

    def switch_off(self) -> None:
        """Switch the motor off; the count remains."""
        self.powered = False
        self.target: float | None = None
        self.motor.rest()
        self.demand.hold(self.demand.position)

    def fail(self, code: int) -> None:
        """Brake, and hold the position with a fault."""
        self.fault = code
        self.target = None

    @property
    def position(self) -> int:
        """Steps since power-up."""
        return round(self.demand.position - self.zero)

    @property
    def flags(self) -> int:
        """Flags of the status."""
        moving = not self.demand.at_rest or self.target not in (None, self.demand.position)
        return (
            self.powered * _ON
            | moving * _MOVING
            | self.motor.at_negative_switch * _OUTER
            | self.motor.at_positive_switch * _INNER
            | (self.deceleration > 0.0) * _SET_UP
        )

    def advance(self, period: float) -> None:
        """Advance by `period` [s]; steps that the motor cannot follow are lost."""
        before = self.demand.position
        self.advance_demand(period)
        self.motor.follow(self.motor.position + self.demand.position - before, period)

    def advance_demand(self, period: float) -> None:
        """Move to the target on a trapezoid, or brake; a switch blocks its direction."""
        if self.target is not None:
            # The outer switch is the negative one.
            towards_switch = -self.outer * (self.target - self.demand.position)
            if self.motor.is_blocked(towards_switch):
                self.target = None
        ramp = self.deceleration
        if self.target is None:
            self.demand.brake(ramp, period)
        else:
            self.demand.approach(self.target, self.speed, ramp, ramp, period)


class StepdirDrives(TextDrives[StepdirDrive]):
    """Board with its motors; the sketch `stepdir.ino` describes its protocol.

    Parameters
    ----------
    motors : mapping of str to MotorSettings
        Mechanics of each axis.
    now : float
        Steady time of power-up [s].
    """

    port = "stepdir"
    intruder = "$7,M,0,10000,1000*7A"
    """Line from another computer that moves the insertion axis."""

    def __init__(self, motors: Mapping[str, MotorSettings], now: float) -> None:
        self._expected = 0
        super().__init__(motors, now, StepdirDrive)

    def handle_line(self, line: str, now: float) -> bytes:
        """Execute a line; drop it if it is damaged or unknown."""
        match = _LINE.fullmatch(line)
        if match is None or _checksum(match[1]) != int(match[5], 16):
            return b""
        number, letter = int(match[2]), match[3]
        if number != self._expected:
            self._fail(LINE_LOST)
        self._expected = (number + 1) % 256
        self._fed = now
        answer = self._execute(letter, *map(int, match[4].split(",")[1:]))
        if answer is None:
            return b""
        body = ",".join((match[2], letter, *answer))
        return f"${body}*{_checksum(body):02X}\n".encode()

    def watch(self, now: float) -> None:
        """Stop if the computer sends no lines."""
        if now - self._fed > self._dead_man:
            self._fail(SILENT)

    def reboot(self, axis: str, now: float) -> None:
        """Interrupt the power of the board."""
        super().reboot(axis, now)
        # Time of the last valid line, and time after which its absence stops the motors [s].
        self._fed, self._dead_man = now, _DEAD_MAN

    def fail(self, axis: str, code: int) -> None:
        """Cause a fault of the board, which brakes both axes."""
        for drive in self.drives.values():
            drive.fail(code)

    def _execute(self, letter: str, axis: int = -1, *values: int) -> tuple[str, ...] | None:
        drive = self.drives.get(_AXES[axis]) if axis in (0, 1) else None
        match letter, values:
            case "I", ():
                return "Emulated stepdir,1", str(MAX_RATE)
            case "R", ():
                for each in self.drives.values():
                    each.fault = 0
                return ()
            case "S", ():
                return self._status()
            case "C", (deceleration, outer, milliseconds) if drive and deceleration > 0:
                drive.deceleration, drive.outer = float(deceleration), 1 if outer > 0 else -1
                self._dead_man = min(max(milliseconds, 50), 500) * 1e-3
                return ()
            case "P", (0,) if drive:
                drive.switch_off()
            case "P", (_,) if drive and drive.deceleration and not self._fault:
                drive.powered = True
            case "M", (position, milliseconds) if drive and drive.powered and not self._fault:
                drive.target = drive.zero + position
                distance = abs(drive.target - drive.demand.position)
                drive.speed = min(distance * 1e3 / max(milliseconds, 1), MAX_RATE)
            case "H", () if drive:
                drive.target = None
        return None

    def _status(self) -> tuple[str, ...]:
        fields = [self._fault]
        for axis in _AXES:
            drive = self.drives.get(axis)
            fields += [drive.position, drive.flags] if drive else [0, 0]
        return tuple(map(str, fields))

    @property
    def _fault(self) -> int:
        return max(drive.fault for drive in self.drives.values())

    def _fail(self, code: int) -> None:
        if not self._fault and any(drive.powered for drive in self.drives.values()):
            self.fail(_AXES[0], code)


def _checksum(text: str) -> int:
    return reduce(lambda total, character: total ^ ord(character), text, 0)
