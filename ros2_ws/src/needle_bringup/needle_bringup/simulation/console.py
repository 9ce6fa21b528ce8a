"""A simulated rig in real time and the console's page on it: what scripts/console runs. No ROS."""

from __future__ import annotations

import os
import socket
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit

from needle_bringup.simulation.console_options import ConsoleOptions, parse_console
from needle_bringup.simulation.node_process import NodeProcess, stop, wait_for
from needle_bringup.simulation.rig_configuration import (
    PACKAGES,
    command_line_parameters,
    write_parameters,
)
from needle_bringup.simulation.simulate import ROS_ARGUMENTS
from needle_core.commands.cli import EXIT_INTERRUPTED, EXIT_MISSED, run_command
from needle_core.errors import UserError
from needle_core.files.installed import find_executable
from needle_core.process.end_request import EndRequest
from needle_core.process.reach import settle_environment
from needle_core.process.ros_domain import own_domain
from needle_core.settings.parameter_files import Parameters

LOOPBACK = "127.0.0.1"
_POLL = 0.1
# The rest of what `simulate` runs records, or stands in for the person.
_RIG = ("sim_rig", "drive_emulator", "device_driver", "stereo_tracker", "plane_controller")
_CONSOLE = "console"
_PARAMETERS = "parameters.yaml"
# As often as a page shows them: to draw and track more leaves two cores no time for the hold [Hz].
_CAMERA_RATE = 10.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `console`; returns its exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    return run_command(lambda: console(parse_console(words)))


def console(options: ConsoleOptions) -> int:
    """Run rig and page until a signal comes.

    Parameters
    ----------
    options : ConsoleOptions
        What to run.

    Returns
    -------
    int
        130 after a signal, 1 where a node ended before.

    Raises
    ------
    UserError
        Where something is missing or a port is taken.
    """
    settle_environment(own_graph=True)
    for port in (options.port, options.port + 1):
        _refuse_taken(port)
    parameters = console_parameters(options)
    packages = {**PACKAGES, _CONSOLE: "needle_console"}
    executables = {node: find_executable(packages[node], node) for node in parameters}
    with (
        EndRequest(None) as end,
        own_domain() as domain,
        tempfile.TemporaryDirectory(prefix="needle_console_") as folder,
    ):
        write_parameters(Path(folder, _PARAMETERS), parameters)
        nodes: list[NodeProcess] = []
        try:
            for name, executable in executables.items():
                nodes.append(_start(name, executable, Path(folder), domain))
            return _watch(nodes, f"http://{LOOPBACK}:{options.port}/", domain, end)
        finally:
            _stop(nodes)


def console_parameters(options: ConsoleOptions) -> Parameters:
    """Return the parameters of each node that runs."""
    rig = command_line_parameters(options.rig, Path())
    parameters = {node: values for node, values in rig.items() if node in _RIG}
    for values in parameters.values():
        values.pop("wait_for_recorder", None)
    parameters["sim_rig"]["camera_rate"] = _CAMERA_RATE
    ports = {"port": options.port, "hold_port": options.port + 1}
    return {**parameters, _CONSOLE: {"address": LOOPBACK, **ports}}


def _start(name: str, executable: str, folder: Path, domain: int) -> NodeProcess:
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain),
        "PYTHONUNBUFFERED": "1",
        # Small matrices: threads only get in the way of the other nodes.
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
    }
    return NodeProcess(
        name,
        [executable, *ROS_ARGUMENTS, "--params-file", str(folder / _PARAMETERS)],
        environment=environment,
        log=folder / f"{name}.log",
    )


def _watch(nodes: Sequence[NodeProcess], address: str, domain: int, end: EndRequest) -> int:
    """Print the address once somebody answers there; return when a signal or a node's end comes."""
    port = urlsplit(address).port or 0
    told = False
    while not end.wanted:
        if not told and _answers(port):
            told = True
            print(f"{address}   (ROS_DOMAIN_ID {domain}; Ctrl-C ends all)", flush=True)
        dead = next((node for node in nodes if node.exit_code is not None), None)
        # Others may end on the same signal.
        if dead is not None and not end.wanted:
            print(f"error: {dead.describe_end()}", file=sys.stderr)
            return EXIT_MISSED
        wait_for(nodes[:1], _POLL)
    return EXIT_INTERRUPTED


def _stop(nodes: Sequence[NodeProcess]) -> None:
    """End the page, so that nobody holds; the driver before its drives; the rest."""
    by_name = {node.name: node for node in nodes}
    first = [by_name.pop(name) for name in (_CONSOLE, "device_driver") if name in by_name]
    warnings = [line for node in first for line in stop([node])] + stop(by_name.values())
    for warning in warnings:
        print(f"warning: {warning}", file=sys.stderr)


def _refuse_taken(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            raise UserError(f"port {port}: {error.strerror}; --port takes another") from error


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(_POLL)
        return probe.connect_ex((LOOPBACK, port)) == 0


if __name__ == "__main__":
    sys.exit(main())
