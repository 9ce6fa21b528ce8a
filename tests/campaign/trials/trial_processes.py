"""The nodes of a trial as processes that can be killed and restarted. Imports no ROS."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from needle_bringup.simulation.node_graph import (
    LOGS,
    PARAMETERS,
    NodeGraph,
    NodeProcess,
    stop,
    wait_for,
)
from needle_bringup.simulation.rig_configuration import (
    PACKAGES,
    command_line_parameters,
    write_parameters,
)
from needle_bringup.simulation.simulate_options import SimulateOptions
from needle_core.files.installed import find_executable
from needle_core.settings.parameter_files import Parameters

_PACKAGES = {**PACKAGES, "console": "needle_console"}
_KILL_GRACE = 5.0


class TrialProcesses(NodeGraph):
    """Nodes in a ROS domain of their own.

    Parameters
    ----------
    folder : Path
        For parameters and logs.
    domain : int
        ROS_DOMAIN_ID.
    parameters : Parameters
        Parameters by node; all nodes are started.
    before : mapping, optional
        Prefix of the command by node.
    """

    def __init__(
        self,
        folder: Path,
        domain: int,
        parameters: Parameters,
        before: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        super().__init__(folder, parameters, ROS_DOMAIN_ID=str(domain))
        self._before = before or {}
        for name in parameters:
            self.begin(name)

    def begin(self, name: str, *command: str, file: Path | None = None) -> None:
        """Start or restart a node, by its executable or another command."""
        command = command or (find_executable(_PACKAGES[name], name),)
        argv = ("--ros-args", "--disable-external-lib-logs", "--params-file")
        self.nodes[name] = NodeProcess(
            name,
            [*self._before.get(name, ()), *command, *argv, str(file or self._folder / PARAMETERS)],
            environment=self._environment,
            log=self._folder / LOGS / f"{name}.log",
        )

    def begin_module(self, name: str, module: str, values: Mapping[str, object]) -> None:
        """Start a node by a module, with these parameters."""
        file = self._folder / f"{name}.yaml"
        write_parameters(file, {name: dict(values)})
        self.begin(name, sys.executable, "-m", module, file=file)

    def kill(self, name: str) -> None:
        """Kill a node with SIGKILL, and wait for its end."""
        self.signal(name, signal.SIGKILL)
        wait_for([self.nodes[name]], _KILL_GRACE)

    def signal(self, name: str, number: signal.Signals) -> None:
        """Send a signal to a node."""
        os.kill(self.nodes[name].pid, number)

    def end(self, name: str) -> None:
        """Stop a node."""
        stop([self.nodes.pop(name)])

    def close(self) -> None:
        """Stop all nodes."""
        self.stop()


def without_recorder(options: SimulateOptions) -> Parameters:
    """Return the parameters of a simulation's nodes without the recorder."""
    parameters = command_line_parameters(options, Path())
    del parameters["recorder"]
    for values in parameters.values():
        values.pop("wait_for_recorder", None)
    return parameters


def graph_in_real_time(seed: int) -> Parameters:
    """Return the parameters of level drive in real time, without a recorder."""
    return without_recorder(SimulateOptions(level="drive", graph=True, seed=seed))
