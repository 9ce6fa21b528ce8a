"""Emulated drives with a text protocol over a byte stream."""

from __future__ import annotations

import abc
import re
from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from typing import Generic, TypeVar

from needle_sim.bus.stream_server import ClientBytes
from needle_sim.drives.emulated_drives import FAULT, MOTION_STEP, EmulatedDrives
from needle_sim.drives.motion_profile import Demand
from needle_sim.drives.motor import Motor, MotorSettings


class TextDrive:
    """Drive of one axis: its motor, demand and power; subclasses add their own registers.

    Parameters
    ----------
    name : str
        Name of the axis.
    settings : MotorSettings
        Mechanics of the axis.

    Attributes
    ----------
    zero : float
        Position at which the drive's count is 0 [true counts].
    powered : bool
        Whether the motor holds its position; without power, friction holds it.
    fault : int
        Code of a fault; 0: none.
    hung : bool
        Whether its processor hangs.
    boots_until : float
        Steady time at which it answers again after power-up [s].
    """

    def __init__(self, name: str, settings: MotorSettings) -> None:
        self.name = name
        self.motor = Motor(settings)
        self.demand = Demand(self.motor.position)
        self.hung = False
        self.boots_until = 0.0
        self.power_up()

    def power_up(self) -> None:
        """Set the registers as at power-up: off, counting from the present position."""
        self.switch_off()
        self.zero = self.motor.position
        self.fault = 0

    def switch_off(self) -> None:
        """Switch the motor off."""
        self.powered = False
        self.motor.rest()
        self.demand.hold(self.motor.position)

    def fail(self, code: int) -> None:
        """Switch off with a fault."""
        self.fault = code
        self.switch_off()

    @property
    def position(self) -> int:
        """Measured position [counts]; a drive without an encoder overrides it."""
        return round(self.motor.position - self.zero)

    @property
    def state_text(self) -> str:
        """State for the diagnostics."""
        return f"{FAULT} 0x{self.fault:04X}" if self.fault else "ON" if self.powered else "OFF"

    def advance(self, period: float) -> None:
        """Advance the powered motor by `period` [s]."""
        self.advance_demand(period)
        self.motor.follow(self.demand.position, period)

    def advance_demand(self, period: float) -> None:
        """Advance the demand along its segment; a drive with other motions overrides it."""
        self.demand.interpolate(period)


Drive = TypeVar("Drive", bound=TextDrive)


class TextDrives(EmulatedDrives, Generic[Drive]):
    """Drives with a text protocol; subclasses define `handle_line`, and `watch` for their timers.

    Parameters
    ----------
    motors : mapping of str to MotorSettings
        Mechanics of each axis.
    now : float
        Steady time of power-up [s].
    make_drive : callable
        Makes the drive of an axis.

    Attributes
    ----------
    drives : dict of str to Drive
        Drive of each axis.
    late : float
        Delay of all replies [s].
    partial : bool
        Whether replies arrive byte by byte, the last byte one poll later.
    wrong, lost : bool
        Whether one bit of the next reply is wrong, or the next reply is lost.
    """

    terminators = b"\n"
    """Bytes that end a line."""
    intruder = ""
    """Line from another client that moves the insertion axis; empty: only one client exists."""
    one_processor = True
    """Whether all axes hang and reboot together."""
    boot_time = 0.3
    """Time from power-up to the first answer [s]."""

    def __init__(
        self,
        motors: Mapping[str, MotorSettings],
        now: float,
        make_drive: Callable[[str, MotorSettings], Drive],
    ) -> None:
        self.drives = {name: make_drive(name, settings) for name, settings in motors.items()}
        super().__init__(self.drives, now)
        self.late = 0.0
        self.partial = self.wrong = self.lost = False
        self._inputs: dict[int, bytes] = defaultdict(bytes)
        # Output with its due times [s].
        self._outbox: deque[tuple[float, bytes]] = deque()
        for name in motors:
            self.reboot(name, now)

    @abc.abstractmethod
    def handle_line(self, line: str, now: float) -> bytes:
        """Execute a line, without its terminator; return the reply."""

    def watch(self, now: float) -> None:
        """Check the drives' own timers; called at every `MOTION_STEP` unless all drives hang."""

    # ---- the connection -----------------------------------------------------------------------

    def receive(self, batch: Sequence[bytes], now: float) -> list[bytes]:
        """Handle bytes from clients at steady time `now` [s]; return the immediate answers."""
        self.advance_to(now)
        for chunk in batch:
            if self.is_cut or self._is_silent(now):
                continue
            client = getattr(chunk, "client", 0)
            pattern = b"[" + re.escape(self.terminators) + b"]"
            *lines, self._inputs[client] = re.split(pattern, self._inputs[client] + chunk)
            for line in lines:
                text = line.decode("ascii", "replace").strip("\r\n")
                self._reply(client, self.handle_line(text, now), now)
        return self._due(now)

    def poll(self, now: float) -> list[bytes]:
        """Advance the drives to steady time `now` [s]; return the data that they sent."""
        self.advance_to(now)
        return self._due(now)

    def foreign(self, line: str) -> None:
        """Execute a command from another client."""
        self.handle_line(line, self._advanced_to)

    def intrude(self) -> bool:
        """Move the insertion axis as another client."""
        if self.intruder:
            self.foreign(self.intruder)
        return bool(self.intruder)

    def _reply(self, client: int, reply: bytes, now: float) -> None:
        if not reply or self.lost:
            self.lost = self.lost and not reply
            return
        if self.wrong:
            self.wrong = False
            middle = len(reply) // 2
            reply = reply[:middle] + bytes([reply[middle] ^ 1]) + reply[middle + 1 :]
        due = now + self.late
        if not self.partial:
            self._outbox.append((due, ClientBytes(reply, client)))
            return
        for index in range(len(reply)):
            is_last = index == len(reply) - 1
            byte = ClientBytes(reply[index : index + 1], client)
            self._outbox.append((due + is_last * MOTION_STEP, byte))

    def _due(self, now: float) -> list[bytes]:
        sent = []
        while self._outbox and self._outbox[0][0] <= now:
            sent.append(self._outbox.popleft()[1])
        return [] if self.is_cut else sent

    def _is_silent(self, now: float) -> bool:
        return all(drive.hung or now < drive.boots_until for drive in self.drives.values())

    # ---- time and faults ----------------------------------------------------------------------

    def advance(self, steps: int) -> None:
        """Advance the motion by a number of `MOTION_STEP`."""
        drives = self.drives.values()
        watches = not all(drive.hung for drive in drives)
        if not any(drive.powered for drive in drives):
            # Without motion, the timers need only the last step.
            steps = 1
        for left in reversed(range(steps)):
            if watches:
                self.watch(self._advanced_to - left * MOTION_STEP)
            for drive in drives:
                if drive.powered:
                    drive.advance(MOTION_STEP)

    def reboot(self, axis: str, now: float) -> None:
        """Interrupt the power of a drive."""
        self._inputs.clear()
        self._outbox.clear()
        for drive in self._together(axis):
            drive.power_up()
            drive.hung = False
            drive.boots_until = now + self.boot_time

    def hang(self, axis: str) -> None:
        """Hang the processor of a drive: it is silent, and its motor stops at the set-point."""
        for drive in self._together(axis):
            drive.hung = True

    def _together(self, axis: str) -> list[Drive]:
        return list(self.drives.values()) if self.one_processor else [self.drives[axis]]
