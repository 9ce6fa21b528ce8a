"""The nodes of a trial as processes that can be killed and started again. No ROS in here."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from needle_bringup.simulation.node_process import NodeProcess, stop, wait_for
from needle_bringup.simulation.rig_configuration import (
    PACKAGES,
    can_adapter,
    command_line_parameters,
    write_parameters,
)
from needle_bringup.simulation.simulate_options import SimulateOptions
from needle_core.errors import UserError
from needle_core.files.installed import find_executable

_PACKAGES = {**PACKAGES, "console": "needle_console"}
_KILL_GRACE = 5.0
_TAKES_COMMANDS = "drive_emulator"

Parameters = dict[str, dict[str, object]]


class TrialProcesses:
    """Nodes in a ROS domain of their own.

    Parameters
    ----------
    folder : Path
        Takes their parameters and logs.
    domain : int
        ROS_DOMAIN_ID.
    parameters : dict
        Node -> parameter -> value.
    started : iterable of str, optional
        Nodes that are started at once; all of them by default.
    before : mapping, optional
        Node -> words before its command.

    Attributes
    ----------
    processes : dict of str to NodeProcess
        The nodes, by name.
    """

    def __init__(
        self,
        folder: Path,
        domain: int,
        parameters: Parameters,
        *,
        started: Iterable[str] | None = None,
        before: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        self._folder = folder
        self._before = before or {}
        self._environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1"}
        self._file = folder / "parameters.yaml"
        write_parameters(self._file, parameters)
        self.processes: dict[str, NodeProcess] = {}
        for name in parameters if started is None else started:
            self.start(name)

    def start(self, name: str) -> None:
        """Start a node, also again."""
        self._run(name, [find_executable(_PACKAGES[name], name)], self._file)

    def start_module(self, name: str, module: str, values: Mapping[str, object]) -> None:
        """Start a node that a module of this package runs, with these parameters."""
        file = self._folder / f"{name}.yaml"
        write_parameters(file, {name: dict(values)})
        self._run(name, [sys.executable, "-m", module], file)

    def _run(self, name: str, command: Sequence[str], file: Path) -> None:
        self.processes[name] = NodeProcess(
            name,
            [
                *self._before.get(name, ()),
                *command,
                *("--ros-args", "--disable-external-lib-logs", "--params-file", str(file)),
            ],
            environment=self._environment,
            log=self._folder / f"{name}.log",
            takes_input=name == _TAKES_COMMANDS,
        )

    def restart(self, name: str) -> None:
        """End a node in order, and start it again."""
        stop([self.processes[name]])
        self.start(name)

    def kill(self, name: str) -> None:
        """End a node as a crash does, and wait until it is gone."""
        self.signal(name, signal.SIGKILL)
        wait_for([self.processes[name]], _KILL_GRACE)

    def signal(self, name: str, number: signal.Signals) -> None:
        """Send a node a signal."""
        os.kill(self.processes[name].pid, number)

    def end(self, name: str) -> None:
        """End a node in order."""
        stop([self.processes.pop(name)])

    def say(self, fault: str) -> None:
        """Give the emulator a fault on command."""
        self.processes[_TAKES_COMMANDS].say(fault)

    def exit_code(self, name: str) -> int | None:
        """Return how a node ended; None while it runs."""
        return self.processes[name].exit_code

    def check(self) -> None:
        """Raise `UserError` if a node has ended."""
        for process in self.processes.values():
            if process.exit_code is not None:
                raise UserError(process.describe_end())

    def log(self, name: str) -> str:
        """Return what a node wrote."""
        return (self._folder / f"{name}.log").read_text("utf-8", errors="replace")

    def memory(self) -> int:
        """Return the memory that all take [bytes]."""
        return sum(self.memories().values())

    def memories(self) -> dict[str, int]:
        """Return the memory that each takes [bytes]."""
        page = os.sysconf("SC_PAGE_SIZE")
        return {
            name: page * int(Path(f"/proc/{process.pid}/statm").read_text("ascii").split()[1])
            for name, process in self.processes.items()
        }

    def close(self) -> None:
        """End the driver, then the rest."""
        stop(process for name, process in self.processes.items() if name == "device_driver")
        stop(self.processes.values())


def drives_and_driver(emulator: Mapping[str, object], driver: Mapping[str, object]) -> Parameters:
    """Return the parameters of drive_emulator and device_driver, which meet at an adapter."""
    return {
        "drive_emulator": {"pty": str(can_adapter()), **emulator},
        "device_driver": {"channel": str(can_adapter()), **driver},
    }


def graph_in_real_time(seed: int) -> Parameters:
    """Return the parameters of level drive in real time, without a recorder.

    Parameters
    ----------
    seed : int
        Of the simulation.
    """
    return without_recorder(SimulateOptions(level="drive", graph=True, seed=seed))


def without_recorder(options: SimulateOptions) -> Parameters:
    """Return the parameters of a simulation's nodes but the recorder, for which none waits."""
    parameters = command_line_parameters(options, Path())
    del parameters["recorder"]
    for values in parameters.values():
        values.pop("wait_for_recorder", None)
    return parameters
