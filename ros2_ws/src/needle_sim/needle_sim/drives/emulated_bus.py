"""CAN bus with both emulated drives, their health, and faults on command."""

from __future__ import annotations

import dataclasses
import enum

from needle_core.can_frame import CanFrame
from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_sim.bus.canopen_device import SYNC
from needle_sim.drives.cia402 import PowerState
from needle_sim.drives.drive_motion import MOTION_STEP
from needle_sim.drives.emulated_drive import EmulatedDrive, EmulatedDriveSettings


@dataclasses.dataclass(frozen=True)
class AxisState:
    """True place of a motor.

    Attributes
    ----------
    position : float
        From the edge of the home switch [m or rad], whatever the drive counts.
    velocity : float
        [m/s or rad/s].
    """

    position: float
    velocity: float


class EmulatedBus:
    """Two drives on one bus.

    Parameters
    ----------
    insertion, rotation : EmulatedDriveSettings
        The drives.
    now : float
        Steady time at which the power comes [s].
    """

    def __init__(
        self,
        insertion: EmulatedDriveSettings,
        rotation: EmulatedDriveSettings,
        now: float,
    ) -> None:
        self.drives = {"insertion": EmulatedDrive(insertion), "rotation": EmulatedDrive(rotation)}
        self._moved_until = now
        self.syncs = 0
        self.is_cut = False
        for drive in self.drives.values():
            drive.power_up(now)

    def receive(self, frame: CanFrame, now: float) -> None:
        """Take a frame from the master at steady time `now` [s]."""
        if self.is_cut:
            return
        self._move_until(now)
        if frame.identifier == SYNC and not frame.remote:
            self.syncs += 1
            for drive in self.drives.values():
                drive.sync()
            return
        for drive in self.drives.values():
            drive.receive(frame, now)

    def poll(self, now: float) -> list[CanFrame]:
        """Let time go by until `now` [s]; return what the drives put on the bus."""
        self._move_until(now)
        for drive in self.drives.values():
            drive.tick(now)
        return self.take_sent()

    def take_sent(self) -> list[CanFrame]:
        """Return what the drives have put on the bus since it was last taken."""
        frames: list[CanFrame] = []
        for drive in self.drives.values():
            frames += drive.device.outbox
            drive.device.outbox.clear()
        return [] if self.is_cut else frames

    def axes(self, now: float) -> dict[str, AxisState]:
        """Return where both motors really are at steady time `now` [s]."""
        self._move_until(now)
        states = {}
        for name, drive in self.drives.items():
            scale = drive.settings.motor.counts_per_unit
            states[name] = AxisState(drive.motor.position / scale, drive.motor.velocity / scale)
        return states

    # ---- faults -------------------------------------------------------------------------------

    def stall(self, axis: str) -> None:
        """Block a motor."""
        self.drives[axis].motor.stalled = True

    def reboot(self, axis: str, now: float) -> None:
        """Take a drive's power away for a moment."""
        self.drives[axis].power_up(now)

    def emergency(self, axis: str, code: int) -> None:
        """Let a drive have a fault of that error code."""
        self.drives[axis].fail(code)

    def hang(self, axis: str) -> None:
        """Let a drive's processor hang: silent, while its motor ends at its set-point."""
        self.drives[axis].hung = True

    def restore(self, now: float) -> None:
        """End what goes on: cut bus, stalled motors, hung processors. Faults stay until reset."""
        self.is_cut = False
        for drive in self.drives.values():
            drive.motor.stalled = False
            if drive.hung:
                drive.hung = False
                # Its timers went on: what it missed meanwhile is seen before what comes now.
                drive.tick(now)

    def _move_until(self, now: float) -> None:
        # Times are rounded; what is a whole number of steps but for that is one.
        steps = int((now - self._moved_until) / MOTION_STEP + 1e-6)
        if steps > 0:
            self._moved_until += steps * MOTION_STEP
            for drive in self.drives.values():
                drive.advance(steps)


def bus_health(bus: EmulatedBus) -> Diagnostic:
    """Return the states of both drives, and what is the matter with them or their bus."""
    states = {name: drive.state.name for name, drive in bus.drives.items()}
    faults = [name for name, state in states.items() if state == PowerState.FAULT.name]
    message = f"fault of {' and '.join(faults)}" if faults else "runs"
    if bus.is_cut:
        message += ", the bus is cut"
    level = Level.WARN if faults or bus.is_cut else Level.OK
    return Diagnostic(level, message, states)


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


class PlugCommand(enum.Enum):
    """Effects of a command on the adapter."""

    OUT = "out"
    IN = "in"


def execute_command(line: str, bus: EmulatedBus, now: float) -> PlugCommand | None:
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
    PlugCommand or None
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
        return PlugCommand.OUT
    else:
        bus.restore(now)
        return PlugCommand.IN
    return None


def _error_code(line: str, word: str) -> int:
    try:
        code = int(word, 0)
    except ValueError:
        raise UserError(f"{line!r}: {word!r} is no error code, such as 0x5530") from None
    if not 1 <= code <= 0xFFFF:
        raise UserError(f"{line!r}: the error code must be within 1..0xFFFF")
    return code
