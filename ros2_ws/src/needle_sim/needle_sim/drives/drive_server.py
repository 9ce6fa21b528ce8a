"""Connects the emulated bus to its adapter: waits for bytes, lets time go by, hands frames on."""

from __future__ import annotations

import select
import time

from needle_sim.bus.pty_port import PtyPort
from needle_sim.drives.emulated_bus import EmulatedBus
from needle_sim.drives.fault_commands import PlugOrder, obey


class DriveServer:
    """Serves one bus at one port; whoever runs it calls `turn` again and again.

    Parameters
    ----------
    bus : EmulatedBus
        The drives.
    port : PtyPort
        Where the computer is.
    """

    def __init__(self, bus: EmulatedBus, port: PtyPort) -> None:
        self.bus = bus
        self._port = port
        # Drives that booted before anybody could hear it are there at once.
        bus.poll(time.monotonic())

    def turn(self, timeout: float) -> None:
        """Wait for input, at most `timeout` [s], and do what is due."""
        select.select(self._port.filenos, [], [], timeout)
        # All that has come first: a heartbeat that waits to be read is not missed.
        for frame in self._port.receive():
            self.bus.receive(frame, time.monotonic())
        self._port.send(self.bus.poll(time.monotonic()))

    def obey(self, line: str) -> None:
        """Carry out a fault on command.

        Raises
        ------
        UserError
            A line that is no command.
        """
        order = obey(line, self.bus, time.monotonic())
        if order is PlugOrder.OUT:
            self._port.unplug()
        elif order is PlugOrder.IN:
            self._port.plug_in()

    def close(self) -> None:
        """Take the adapter away."""
        self._port.unplug()
