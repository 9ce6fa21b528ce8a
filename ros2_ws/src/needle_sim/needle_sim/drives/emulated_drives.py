"""Emulated drives behind one connection: their motors, time, and faults on command."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from needle_sim.drives.motor import Motor

MOTION_STEP = 0.001
"""Time step of the motion [s]."""
FAULT = "FAULT"
"""Prefix of the state of a drive with a fault."""


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


class AxisDrive(Protocol):
    """Drive of one axis.

    Attributes
    ----------
    motor : Motor
        Its motor.
    hung : bool
        Whether its processor hangs.
    """

    motor: Motor
    hung: bool

    @property
    def state_text(self) -> str:
        """State for the diagnostics; it begins with `FAULT` for a fault."""

    def fail(self, code: int) -> None:
        """Enter a fault with this error code."""


class EmulatedDrives(abc.ABC):
    """Drives of one or two axes behind one connection.

    Parameters
    ----------
    drives : mapping of str to AxisDrive
        Drive of each axis (`insertion`, `rotation`).
    now : float
        Steady time of power-up [s].

    Attributes
    ----------
    port : str
        Name of the connection.
    is_cut : bool
        Whether the connection loses everything in both directions.
    """

    port: str

    def __init__(self, drives: Mapping[str, AxisDrive], now: float) -> None:
        self._drives = drives
        self.motors = {name: drive.motor for name, drive in drives.items()}
        self._advanced_to = now
        self.is_cut = False

    @abc.abstractmethod
    def receive(self, batch: Sequence[Any], now: float) -> list[Any]:
        """Handle the computer's input at steady time `now` [s]; return the immediate answers."""

    @abc.abstractmethod
    def poll(self, now: float) -> list[Any]:
        """Advance the drives to steady time `now` [s]; return the data that they sent."""

    def states(self) -> dict[str, str]:
        """Return the state of each drive; it begins with `FAULT` for a fault."""
        return {name: drive.state_text for name, drive in self._drives.items()}

    @abc.abstractmethod
    def advance(self, steps: int) -> None:
        """Advance the motion by a number of `MOTION_STEP`."""

    def axes(self, now: float) -> dict[str, AxisState]:
        """Return the true states of the motors at steady time `now` [s]."""
        self.advance_to(now)
        return {
            name: AxisState(motor.position / motor.scale, motor.velocity / motor.scale)
            for name, motor in self.motors.items()
        }

    def advance_to(self, now: float) -> None:
        """Advance the motion to steady time `now` [s]."""
        # The tolerance compensates for the rounding of times.
        steps = int((now - self._advanced_to) / MOTION_STEP + 1e-6)
        if steps > 0:
            self._advanced_to += steps * MOTION_STEP
            self.advance(steps)

    # ---- faults -------------------------------------------------------------------------------

    def stall(self, axis: str) -> None:
        """Block a motor."""
        self.motors[axis].stalled = True

    @abc.abstractmethod
    def reboot(self, axis: str, now: float) -> None:
        """Interrupt the power of a drive."""

    def fail(self, axis: str, code: int) -> None:
        """Cause a fault with this error code in a drive."""
        self._drives[axis].fail(code)

    def hang(self, axis: str) -> None:
        """Hang the processor of a drive: it is silent, and its motor stops at the set-point."""
        self._drives[axis].hung = True

    def intrude(self) -> bool:
        """Interfere as another computer; return False if none can be connected."""
        return False

    def restore(self, now: float) -> None:
        """End cut connection, stalled motors and hung processors; faults remain until reset."""
        self.is_cut = False
        for drive in self._drives.values():
            drive.motor.stalled = drive.hung = False
