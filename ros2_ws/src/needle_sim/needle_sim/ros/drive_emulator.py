"""The `drive_emulator` executable."""

from __future__ import annotations

import os
import select
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from needle_core.can_frame import CAN
from needle_core.component import RealPort
from needle_core.ros.main import run_component
from needle_sim.bus.pty_can import PtyCan
from needle_sim.bus.stream_server import StreamServer
from needle_sim.drive_emulator import (
    ADAPTERS,
    CIA402,
    COMMAND_LINES,
    COMMANDS,
    DriveEmulator,
    DriveEmulatorParameters,
)

HELP = f"""\
drive_emulator: emulates the drives of insertion and rotation with their motors.

drives = cia402: a stepper and a servo on a CAN bus. A pseudo-terminal acts as serial adapter
(slcan) to the bus. The drives support profile position, homing (methods 17, 18, 35, 37) and cyclic
synchronous position mode, software limits, following errors, emergency messages, and heartbeats in
both directions.

drives = galil, zaber or stepdir: a controller that speaks lines of text at a TCP port. Two names
(galil,cia402) are those of insertion and rotation.

To run it with a driver:
    ros2 run needle_sim drive_emulator --ros-args -p pty:=/tmp/can
    ros2 run needle_device_driver device_driver --ros-args -p link:=slcan -p channel:=/tmp/can

To inject a fault, type a line into this program's terminal or write it to its standard input:
{"".join(f"    {line}" + chr(10) for line in COMMANDS.splitlines())}
Publishes   sim/drive_positions (50 Hz): true positions of the motors, from the edge of the home
            switch, independent of the drives' counters
"""

_WAKE_UP_PERIOD = 0.2


class _CommandLines:
    """Port with the lines of this program's input."""

    def __init__(self) -> None:
        self._is_closed = False

    def open(self, arrive: Callable[[Any], None]) -> None:
        try:
            terminal = sys.stdin.fileno()
        except (AttributeError, ValueError, OSError):
            # The program has no input.
            return
        threading.Thread(target=self._read, args=(terminal, arrive), daemon=True).start()

    def send(self, batch: tuple[Any, ...]) -> None:
        """Do nothing: lines have no answer."""

    def close(self) -> None:
        self._is_closed = True

    def _read(self, terminal: int, arrive: Callable[[Any], None]) -> None:
        rest = b""
        while not self._is_closed:
            if not select.select([terminal], [], [], _WAKE_UP_PERIOD)[0]:
                continue
            # While this program runs in the background, terminal input belongs to the shell.
            if os.isatty(terminal) and os.tcgetpgrp(terminal) != os.getpgrp():
                continue
            data = os.read(terminal, 4096)
            if not data:
                return
            *lines, rest = (rest + data).split(b"\n")
            if lines:
                arrive(tuple(line.decode(errors="replace") for line in lines if line.strip()))


class _Plugs:
    """Port that plugs and unplugs the adapters."""

    def __init__(self, adapters: Iterable[PtyCan | StreamServer]) -> None:
        self._adapters = tuple(adapters)

    def open(self, arrive: Callable[[Any], None]) -> None:
        """Do nothing: the plug has no input."""

    def send(self, batch: tuple[bool, ...]) -> None:
        for plugged_in in batch:
            for adapter in self._adapters:
                adapter.plug(plugged_in=plugged_in)

    def close(self) -> None:
        """Do nothing: each port removes its own adapter."""


def _ports(settings: DriveEmulatorParameters) -> Mapping[str, RealPort]:
    adapters: dict[str, PtyCan | StreamServer] = {}
    for name in settings.axes_of:
        if name == CIA402:
            adapters[CAN] = PtyCan(Path(settings.pty).expanduser() if settings.pty else None)
            print(f"slcan adapter at {adapters[CAN].path}", file=sys.stderr, flush=True)
        else:
            adapters[name] = StreamServer(settings.listen + len(adapters))
            print(f"{name} at {adapters[name].path}", file=sys.stderr, flush=True)
    return {**adapters, ADAPTERS: _Plugs(adapters.values()), COMMAND_LINES: _CommandLines()}


def main() -> int:
    """Run the emulator; return its exit code."""
    return run_component(
        "drive_emulator",
        DriveEmulatorParameters,
        lambda settings, name: DriveEmulator(settings, name, time.monotonic()),
        help_text=HELP,
        ports=_ports,
        shared_memory=False,
    )


if __name__ == "__main__":
    sys.exit(main())
