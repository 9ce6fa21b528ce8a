"""The whole graph of level drive in real time, node by node, for trials. No ROS in here."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from needle_bringup.installed import find_executable
from needle_bringup.node_process import NodeProcess, stop, wait_for
from needle_bringup.rig_configuration import (
    PACKAGES,
    command_line_parameters,
    merge,
    nodes_of,
    rig_parameters,
    write_parameters,
)
from needle_bringup.simulate_options import SimulateOptions
from needle_common.errors import UserError

_KILL_GRACE = 5.0


class GraphProcesses:
    """Every node but the recorder; each can be killed and started again.

    Parameters
    ----------
    folder : Path
        Takes parameters and logs.
    domain : int
        ROS_DOMAIN_ID.
    seed : int
        Of the simulation.
    """

    def __init__(self, folder: Path, domain: int, seed: int) -> None:
        self._folder = folder
        self._environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1"}
        options = SimulateOptions(level="drive", real_time_factor=1.0, seed=seed)
        parameters = merge(rig_parameters(), command_line_parameters(options, folder / "none"))
        for values in parameters.values():
            values.pop("wait_for_recorder", None)
        names = [node for node in nodes_of(options) if node != "recorder"]
        write_parameters(folder / "parameters.yaml", {node: parameters[node] for node in names})
        self._processes: dict[str, NodeProcess] = {}
        for name in names:
            self.start(name)

    def start(self, name: str) -> None:
        """Start a node, also again."""
        self._processes[name] = NodeProcess(
            name,
            [
                find_executable(PACKAGES[name], name),
                *("--ros-args", "--disable-external-lib-logs"),
                *("--params-file", str(self._folder / "parameters.yaml")),
            ],
            environment=self._environment,
            log=self._folder / f"{name}.log",
        )

    def kill(self, name: str) -> None:
        """End a node as a crash does."""
        process = self._processes[name]
        os.kill(process.pid, signal.SIGKILL)
        wait_for([process], _KILL_GRACE)

    def restart(self, name: str) -> None:
        """End a node in order, and start it again."""
        stop([self._processes[name]])
        self.start(name)

    def check(self) -> None:
        """Raise `UserError` if a node has ended."""
        for process in self._processes.values():
            if process.exit_code is not None:
                raise UserError(process.describe_end())

    def stop(self) -> None:
        """End the driver, then the rest."""
        stop([self._processes["device_driver"]])
        stop(self._processes.values())
