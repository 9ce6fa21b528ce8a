"""Emulated drives and the driver that moves them, as processes of a trial. No ROS in here."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping
from pathlib import Path

from needle_bringup.installed import find_executable
from needle_bringup.node_process import NodeProcess, stop, wait_for
from needle_bringup.rig_configuration import can_adapter
from needle_common.errors import UserError

_PACKAGES = {"drive_emulator": "needle_sim", "device_driver": "needle_device_driver"}
_KILL_GRACE = 5.0


class DriveProcesses:
    """Both processes, in a ROS domain.

    Parameters
    ----------
    folder : Path
        Takes their logs.
    domain : int
        ROS_DOMAIN_ID.
    parameters : mapping
        Node -> parameter -> value, beyond the adapter where they meet.
    """

    def __init__(
        self, folder: Path, domain: int, parameters: Mapping[str, Mapping[str, object]]
    ) -> None:
        self._folder = folder
        self._environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1"}
        self._parameters = parameters
        self._processes: dict[str, NodeProcess] = {}
        for name in _PACKAGES:
            self.start(name)

    def start(self, name: str) -> None:
        """Start `drive_emulator` or `device_driver`, also again."""
        meeting = "pty" if name == "drive_emulator" else "channel"
        values = {meeting: str(can_adapter()), **self._parameters.get(name, {})}
        command = [find_executable(_PACKAGES[name], name), "--ros-args"]
        for key, value in values.items():
            shown = str(value).lower() if isinstance(value, bool) else value
            command += ["-p", f"{key}:={shown}"]
        self._processes[name] = NodeProcess(
            name,
            [*command, "--disable-external-lib-logs"],
            environment=self._environment,
            log=self._folder / f"{name}.log",
            takes_input=name == "drive_emulator",
        )

    def kill(self, name: str) -> None:
        """End a process as a crash does, and wait until it is gone."""
        process = self._processes[name]
        os.kill(process.pid, signal.SIGKILL)
        wait_for([process], _KILL_GRACE)

    def say(self, fault: str) -> None:
        """Give the emulator a fault on command."""
        self._processes["drive_emulator"].say(fault)

    def check(self) -> None:
        """Raise `UserError` if a process has ended."""
        for process in self._processes.values():
            if process.exit_code is not None:
                raise UserError(process.describe_end())

    def log(self, name: str) -> str:
        """Return what a process wrote."""
        return (self._folder / f"{name}.log").read_text("utf-8", errors="replace")

    def memory(self) -> dict[str, int]:
        """Return the memory in use of each process [bytes]."""
        page = os.sysconf("SC_PAGE_SIZE")
        return {
            name: int(Path(f"/proc/{process.pid}/statm").read_text("ascii").split()[1]) * page
            for name, process in self._processes.items()
        }

    def stop(self) -> list[str]:
        """End the driver, then the drives; return a warning for each that had to be killed."""
        return [
            *stop([self._processes["device_driver"]]),
            *stop([self._processes["drive_emulator"]]),
        ]
