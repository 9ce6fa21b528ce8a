"""A rig as ROS nodes, one process each: started, watched, and ended in their order."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from needle_bringup.simulation.node_process import RECORDER_GRACE, NodeProcess, stop
from needle_bringup.simulation.rig_configuration import write_parameters
from needle_core.commands.cli import EXIT_BAD_INPUT, EXIT_MISSED
from needle_core.errors import UserError
from needle_core.files.installed import find_executable
from needle_core.settings.parameter_files import Parameters

LOGS, PARAMETERS = "logs", "parameters.yaml"
OPERATOR = "simulated_operator"
# rclpy's own log files would double those in LOGS.
_ROS_ARGUMENTS = ("--ros-args", "--disable-external-lib-logs")


class NodeFailedError(UserError):
    """A node that ended before its time.

    Parameters
    ----------
    node : NodeProcess
        Which one.
    """

    def __init__(self, node: NodeProcess) -> None:
        self.is_bad_input = node.exit_code == EXIT_BAD_INPUT and node.name != OPERATOR
        where = "" if self.is_bad_input else f" (all it said is in {node.log})"
        super().__init__(node.describe_end() + where)


class NodeGraph:
    """Nodes of a rig.

    Parameters
    ----------
    folder : Path
        Takes their parameters and logs.
    parameters : Parameters
        Node to its parameters: of all that will be started.
    variables : str
        Of the nodes' environment, beside this process's own.

    Attributes
    ----------
    nodes : dict of str to NodeProcess
        Those that were started.
    """

    def __init__(self, folder: Path, parameters: Parameters, **variables: str) -> None:
        self.nodes: dict[str, NodeProcess] = {}
        self._folder = folder
        self._environment = {
            **os.environ,
            "PYTHONUNBUFFERED": "1",
            # Small matrices: threads only get in each other's way, and in that of other nodes.
            "OPENBLAS_NUM_THREADS": "1",
            "OMP_NUM_THREADS": "1",
            **variables,
        }
        write_parameters(folder / PARAMETERS, parameters)
        (folder / LOGS).mkdir()

    def start(self, package: str, name: str, pass_fds: Sequence[int] = ()) -> NodeProcess:
        """Start a node of a package."""
        executable, file = find_executable(package, name), str(self._folder / PARAMETERS)
        node = self.nodes[name] = NodeProcess(
            name,
            [executable, *_ROS_ARGUMENTS, "--params-file", file],
            environment=self._environment,
            log=self._folder / LOGS / f"{name}.log",
            pass_fds=pass_fds,
        )
        return node

    def check(self) -> None:
        """Look whether all run that should: all but the operator.

        Raises
        ------
        NodeFailedError
            If one has ended.
        """
        for name, node in self.nodes.items():
            if name != OPERATOR and node.exit_code is not None:
                raise NodeFailedError(node)

    def stop(self) -> None:
        """End the operator, then the others, then the recorder that still records their ends.

        The driver switches the drives off before they, too, are gone.
        """
        rest = dict(self.nodes)
        recorder = rest.pop("recorder", None)
        warnings: list[str] = []
        for first in (OPERATOR, "device_driver"):
            warnings += stop([rest.pop(first)]) if first in rest else []
        warnings += stop(rest.values())
        if recorder is not None:
            warnings += stop([recorder], RECORDER_GRACE)
            if recorder.exit_code == EXIT_MISSED:
                said = [line for line in recorder.tail(3) if line.startswith("error: ")]
                warnings += [line.removeprefix("error: ") for line in said] or [
                    recorder.describe_end()
                ]
        for warning in warnings:
            print(f"warning: {warning}", file=sys.stderr)
