"""CAN bus with one or two emulated drives."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from needle_core.can_frame import CAN, CanFrame
from needle_sim.bus.canopen_device import SYNC
from needle_sim.drives.cia402 import EmulatedDriveSettings
from needle_sim.drives.emulated_drive import EmulatedDrive
from needle_sim.drives.emulated_drives import EmulatedDrives


class EmulatedBus(EmulatedDrives):
    """CiA 402 drives on one bus.

    Parameters
    ----------
    settings : iterable of EmulatedDriveSettings
        Settings of the drives.
    now : float
        Steady time of power-up [s].
    """

    port = CAN

    def __init__(self, settings: Iterable[EmulatedDriveSettings], now: float) -> None:
        self.drives = {each.name: EmulatedDrive(each) for each in settings}
        super().__init__(self.drives, now)
        self.syncs = 0
        for drive in self.drives.values():
            drive.power_up(now)

    def receive(self, batch: Sequence[CanFrame], now: float) -> list[CanFrame]:
        """Handle frames from the master at steady time `now` [s]; return the immediate answers."""
        if not self.is_cut:
            self.advance_to(now)
            for frame in batch:
                is_sync = frame.identifier == SYNC and not frame.remote
                self.syncs += is_sync
                for drive in self.drives.values():
                    if is_sync:
                        drive.sync()
                    else:
                        drive.receive(frame, now)
        return self._drain_outboxes()

    def poll(self, now: float) -> list[CanFrame]:
        """Advance the drives to steady time `now` [s]; return the frames that they sent."""
        self.advance_to(now)
        for drive in self.drives.values():
            drive.tick(now)
        return self._drain_outboxes()

    def advance(self, steps: int) -> None:
        """Advance the motion by a number of `MOTION_STEP`."""
        for drive in self.drives.values():
            drive.advance(steps)

    def reboot(self, axis: str, now: float) -> None:
        """Interrupt the power of a drive."""
        self.drives[axis].power_up(now)

    def intrude(self) -> bool:
        """Simulate a SYNC from another master."""
        next(iter(self.drives.values())).outbox.append(CanFrame(SYNC))
        return True

    def restore(self, now: float) -> None:
        """End cut bus, stalled motors and hung processors; drive faults remain until reset."""
        hung = [drive for drive in self.drives.values() if drive.hung]
        super().restore(now)
        for drive in hung:
            # Its timers kept running: handle expired ones before new frames.
            drive.tick(now)

    def _drain_outboxes(self) -> list[CanFrame]:
        """Return the frames that the drives sent since the last call."""
        frames: list[CanFrame] = []
        for drive in self.drives.values():
            frames += drive.outbox
            drive.outbox.clear()
        return [] if self.is_cut else frames
