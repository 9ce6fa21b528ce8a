"""The rig as ROS nodes, one process each, which are started, monitored and ended in order."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from needle_bringup.simulation.rig_configuration import write_parameters
from needle_core.commands.cli import EXIT_BAD_INPUT, EXIT_MISSED
from needle_core.errors import UserError
from needle_core.files.installed import find_executable
from needle_core.settings.parameter_files import Parameters

LOGS, PARAMETERS = "logs", "parameters.yaml"
OPERATOR = "simulated_operator"
# rclpy's log files would duplicate those in LOGS.
_ROS_ARGUMENTS = ("--ros-args", "--disable-external-lib-logs")
INTERRUPT_GRACE = 5.0
TERMINATE_GRACE = 3.0
# A slow disk delays the end of the recorder.
RECORDER_GRACE = 30.0
POLL = 0.01
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None, use_errno=True)


class NodeProcess:
    """Process in its own session that ends with its parent, even if the parent is killed.

    Parameters
    ----------
    name : str
        The node's name.
    command : sequence of str
        The command line.
    environment : mapping
        Complete environment of the process.
    log : Path
        File for its output.
    pass_fds : sequence of int
        File descriptors that it inherits.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        *,
        environment: Mapping[str, str],
        log: Path,
        pass_fds: Sequence[int] = (),
    ) -> None:
        self.name = name
        self.log = log
        parent = os.getpid()

        def end_with_parent() -> None:
            _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
            if os.getppid() != parent:
                os._exit(1)

        with log.open("ab") as output:
            self._process = subprocess.Popen(
                list(command),
                env=dict(environment),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                pass_fds=pass_fds,
                start_new_session=True,
                preexec_fn=end_with_parent,  # noqa: PLW1509
            )

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def exit_code(self) -> int | None:
        """Exit code, negative for a signal; None while it runs."""
        return self._process.poll()

    @property
    def last_line(self) -> str:
        """Last non-empty line of its output."""
        lines = [line.strip() for line in self.tail(20) if line.strip()]
        return lines[-1] if lines else ""

    def tail(self, count: int) -> list[str]:
        """Return the last `count` lines of its output."""
        return self.log.read_text(encoding="utf-8", errors="replace").splitlines()[-count:]

    def describe_end(self) -> str:
        """Describe how the process ended."""
        code = self.exit_code
        if code is None:
            return f"{self.name} runs"
        how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        text = self.last_line.removeprefix("error: ")
        return f"{self.name} ended with {how}" + (f": {text}" if text else "")

    def signal_group(self, number: signal.Signals) -> None:
        """Send a signal to the process group."""
        try:
            os.killpg(self._process.pid, number)
        except ProcessLookupError:
            return


def wait_for(processes: Iterable[NodeProcess], timeout: float) -> list[NodeProcess]:
    """Wait up to `timeout` [s] until all have ended; return those that have not."""
    deadline = time.monotonic() + timeout
    running = list(processes)
    while True:
        running = [process for process in running if process.exit_code is None]
        if not running or time.monotonic() >= deadline:
            return running
        time.sleep(POLL)


def stop(processes: Iterable[NodeProcess], grace: float = INTERRUPT_GRACE) -> list[str]:
    """End processes by SIGINT, then SIGTERM, then SIGKILL.

    Parameters
    ----------
    processes : iterable of NodeProcess
        The processes; they may have ended already.
    grace : float
        Time for an orderly end [s].

    Returns
    -------
    list of str
        A warning for each process that had to be killed.
    """
    started = list(processes)
    running = [process for process in started if process.exit_code is None]
    for process in running:
        process.signal_group(signal.SIGINT)
    running = wait_for(running, grace)
    for process in running:
        process.signal_group(signal.SIGTERM)
    stubborn = wait_for(running, TERMINATE_GRACE)
    for process in started:
        # A process that has ended may have left child processes in its group.
        process.signal_group(signal.SIGKILL)
    wait_for(stubborn, TERMINATE_GRACE)
    return [f"{process.name} did not end on SIGINT and SIGTERM, killed" for process in stubborn]


class NodeFailedError(UserError):
    """Premature end of a node.

    Parameters
    ----------
    node : NodeProcess
        The node.
    """

    def __init__(self, node: NodeProcess) -> None:
        self.is_bad_input = node.exit_code == EXIT_BAD_INPUT and node.name != OPERATOR
        where = "" if self.is_bad_input else f" (its output is in {node.log})"
        super().__init__(node.describe_end() + where)


class NodeGraph:
    """Nodes of a rig.

    Parameters
    ----------
    folder : Path
        Folder for their parameters and logs.
    parameters : Parameters
        Parameters of all nodes to be started, by node.
    variables : str
        Environment variables of the nodes, in addition to those of this process.

    Attributes
    ----------
    nodes : dict of str to NodeProcess
        Started nodes.
    """

    def __init__(self, folder: Path, parameters: Parameters, **variables: str) -> None:
        self.nodes: dict[str, NodeProcess] = {}
        self._folder = folder
        self._environment = {
            **os.environ,
            "PYTHONUNBUFFERED": "1",
            # One thread per node, because the matrices are small.
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
        """Check that all nodes except the operator are running.

        Raises
        ------
        NodeFailedError
            If one has ended.
        """
        for name, node in self.nodes.items():
            if name != OPERATOR and node.exit_code is not None:
                raise NodeFailedError(node)

    def stop(self) -> None:
        """End the operator, the driver, the other nodes, and the recorder last.

        The driver switches the drives off before the emulated drives end.
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
                errors = [line for line in recorder.tail(3) if line.startswith("error: ")]
                warnings += [line.removeprefix("error: ") for line in errors] or [
                    recorder.describe_end()
                ]
        for warning in warnings:
            print(f"warning: {warning}", file=sys.stderr)
