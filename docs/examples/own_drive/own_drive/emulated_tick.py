"""Emulator of the Tick drive, which shares no code with the backend."""

from __future__ import annotations

from collections.abc import Mapping

from needle_sim.drives.motor import MotorSettings
from needle_sim.drives.text_drives import TextDrive, TextDrives

_AXES = ("insertion", "rotation")


class TickDrive(TextDrive):
    """One axis: it moves to its target at constant speed, and a switch blocks its direction."""

    def power_up(self) -> None:
        """Set the registers as at power-up."""
        super().power_up()
        self.is_set_up = False

    def move(self, target: int, speed: int) -> None:
        """Begin a move."""
        way = target + self.zero - self.demand.position
        if way != 0.0 and speed > 0:
            self.demand.begin_segment(target + self.zero, abs(way) / speed)

    def advance_demand(self, period: float) -> None:
        """Advance the move."""
        way = self.demand.velocity
        outwards = way < 0.0 and self.motor.at_negative_switch
        if outwards or (way > 0.0 and self.motor.at_positive_switch):
            self.demand.hold(self.demand.position)
        super().advance_demand(period)

    @property
    def flags(self) -> int:
        """Flags of the state."""
        return (
            (not self.demand.at_rest) * 1
            | self.powered * 2
            | self.motor.at_negative_switch * 4
            | self.motor.at_positive_switch * 8
            | bool(self.fault) * 16
            | self.is_set_up * 32
        )


class TickDrives(TextDrives[TickDrive]):
    """Both axes behind one serial line."""

    port = "tick"

    def __init__(self, motors: Mapping[str, MotorSettings], now: float) -> None:
        super().__init__(motors, now, TickDrive)

    def handle_line(self, line: str, now: float) -> bytes:
        """Execute a line."""
        match line.split():
            case ["I"]:
                return b"I Emulated Tick 1\n"
            case ["Z", axis] if drive := self._drive(axis):
                drive.fault, drive.is_set_up = 0, True
                return b"Z\n"
            case ["E", axis, on] if drive := self._drive(axis):
                drive.switch_off()
                drive.powered = on == "1" and drive.is_set_up and not drive.fault
            case ["G", axis, target, speed] if (drive := self._drive(axis)) and drive.powered:
                drive.move(int(target), int(speed))
            case ["H", axis] if drive := self._drive(axis):
                drive.demand.hold(drive.demand.position)
            case ["Q", number]:
                states = (self.drives.get(name) for name in _AXES)
                words = (f"{at.position} {at.flags}" if at else "0 0" for at in states)
                return f"Q {number} {' '.join(words)}\n".encode()
        return b""

    def _drive(self, axis: str) -> TickDrive | None:
        return self.drives.get(_AXES[int(axis)])
