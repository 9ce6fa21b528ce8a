"""CAN bus with both emulated drives, their health, and faults on command."""

from __future__ import annotations

import contextlib
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
    """True state of a motor.

    Attributes
    ----------
    position : float
        Distance from the edge of the home switch [m or rad], independent of the drive's count.
    velocity : float
        Velocity [m/s or rad/s].
    """

    position: float
    velocity: float


class EmulatedBus:
    """Two drives on one bus.

    Parameters
    ----------
    insertion, rotation : EmulatedDriveSettings
        Settings of the drives.
    now : float
        Steady time of power-up [s].
    """

    def __init__(
        self,
        insertion: EmulatedDriveSettings,
        rotation: EmulatedDriveSettings,
        now: float,
    ) -> None:
        self.drives = {"insertion": EmulatedDrive(insertion), "rotation": EmulatedDrive(rotation)}
        self._advanced_to = now
        self.syncs = 0
        self.is_cut = False
        for drive in self.drives.values():
            drive.power_up(now)

    def receive(self, frame: CanFrame, now: float) -> None:
        """Handle a frame of the master at steady time `now` [s]."""
        if self.is_cut:
            return
        self._advance_to(now)
        if frame.identifier == SYNC and not frame.remote:
            self.syncs += 1
            for drive in self.drives.values():
                drive.sync()
            return
        for drive in self.drives.values():
            drive.receive(frame, now)

    def poll(self, now: float) -> list[CanFrame]:
        """Advance the drives to steady time `now` [s]; return the frames that they sent."""
        self._advance_to(now)
        for drive in self.drives.values():
            drive.tick(now)
        return self.drain_outboxes()

    def drain_outboxes(self) -> list[CanFrame]:
        """Return the frames that the drives sent since the last call."""
        frames: list[CanFrame] = []
        for drive in self.drives.values():
            frames += drive.device.outbox
            drive.device.outbox.clear()
        return [] if self.is_cut else frames

    def axes(self, now: float) -> dict[str, AxisState]:
        """Return the true states of both motors at steady time `now` [s]."""
        self._advance_to(now)
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
        """Interrupt the power of a drive."""
        self.drives[axis].power_up(now)

    def emergency(self, axis: str, code: int) -> None:
        """Cause a fault with this error code in a drive."""
        self.drives[axis].fail(code)

    def hang(self, axis: str) -> None:
        """Hang the processor of a drive: it is silent, and its motor ends at the set-point."""
        self.drives[axis].hung = True

    def restore(self, now: float) -> None:
        """End cut bus, stalled motors and hung processors; drive faults stay until reset."""
        self.is_cut = False
        for drive in self.drives.values():
            drive.motor.stalled = False
            if drive.hung:
                drive.hung = False
                # Its timers kept running: handle expired ones before new frames.
                drive.tick(now)

    def _advance_to(self, now: float) -> None:
        # The tolerance compensates the rounding of times.
        steps = int((now - self._advanced_to) / MOTION_STEP + 1e-6)
        if steps > 0:
            self._advanced_to += steps * MOTION_STEP
            for drive in self.drives.values():
                drive.advance(steps)


def bus_health(bus: EmulatedBus) -> Diagnostic:
    """Return the states of both drives, and the faults of drives and bus, as a diagnostic."""
    states = {name: drive.state.name for name, drive in bus.drives.items()}
    faults = [name for name, state in states.items() if state == PowerState.FAULT.name]
    message = f"fault of {' and '.join(faults)}" if faults else "runs"
    if bus.is_cut:
        message += ", the bus is cut"
    level = Level.WARN if faults or bus.is_cut else Level.OK
    return Diagnostic(level, message, states)


COMMANDS = """\
cut_bus             lose all frames in both directions; the adapter stays connected
unplug              remove the adapter
stall AXIS          block the motor
reboot AXIS         interrupt the drive's power
emcy AXIS CODE      put the drive into a fault with this error code, such as 0x5530
hang AXIS           hang the drive's processor: it is silent, the motor ends at its set-point
restore             end cut_bus, unplug, stall and hang; AXIS is insertion or rotation"""


class PlugCommand(enum.Enum):
    """Commands to the adapter."""

    OUT = "out"
    IN = "in"


def execute_command(line: str, bus: EmulatedBus, now: float) -> PlugCommand | None:
    """Execute a fault command at steady time `now` [s].

    Parameters
    ----------
    line : str
        One of `COMMANDS`.
    bus : EmulatedBus
        Bus with the drives.
    now : float
        Steady time [s].

    Returns
    -------
    PlugCommand or None
        Remaining command to the adapter.

    Raises
    ------
    UserError
        If the line is not a valid command.
    """
    match line.split():
        case ["cut_bus"]:
            bus.is_cut = True
        case ["unplug"]:
            return PlugCommand.OUT
        case ["restore"]:
            bus.restore(now)
            return PlugCommand.IN
        case ["stall", ("insertion" | "rotation") as axis]:
            bus.stall(axis)
        case ["reboot", ("insertion" | "rotation") as axis]:
            bus.reboot(axis, now)
        case ["hang", ("insertion" | "rotation") as axis]:
            bus.hang(axis)
        case ["emcy", ("insertion" | "rotation") as axis, text] if code := _error_code(text):
            bus.emergency(axis, code)
        case _:
            raise UserError(f"{line!r} is not a command; known:\n{COMMANDS}")
    return None


def _error_code(text: str) -> int:
    """Return an error code of 16 bits; 0 for any other text."""
    with contextlib.suppress(ValueError):
        code = int(text, 0)
        return code if 1 <= code <= 0xFFFF else 0
    return 0
