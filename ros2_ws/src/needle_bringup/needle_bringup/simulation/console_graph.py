"""The console's rig as ROS nodes, beside RViz and Foxglove: `scripts/console --graph`."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from needle_bringup.simulation.console_options import LOOPBACK, ConsoleOptions
from needle_bringup.simulation.launch_nodes import LAUNCHED_PACKAGES
from needle_bringup.simulation.node_graph import NodeGraph
from needle_bringup.simulation.node_process import wait_for
from needle_core.commands.cli import EXIT_INTERRUPTED
from needle_core.process.discovery import clean_environment
from needle_core.process.shutdown import ShutdownFlag
from needle_core.settings.parameter_files import Parameters

# What stands in for the person, and what records.
_LEFT_OUT = ("simulated_operator", "recorder")
_POLL = 0.1


def run_console_graph(options: ConsoleOptions, rig: Parameters, end: ShutdownFlag) -> int:
    """Run the rig, its page and its live view as nodes in this shell's ROS domain.

    Parameters
    ----------
    options : ConsoleOptions
        What to run.
    rig : Parameters
        Node to its parameters.
    end : ShutdownFlag
        When to end.

    Returns
    -------
    int
        130 after a signal.

    Raises
    ------
    NodeFailedError
        If a node ended before.
    """
    clean_environment()
    nodes = {name: values for name, values in rig.items() if name not in _LEFT_OUT}
    nodes["console"] = {"port": options.port, "hold_port": options.port + 1}
    packages = {**LAUNCHED_PACKAGES, "console": "needle_console"}
    folder = Path(tempfile.mkdtemp(prefix="needle_console_"))
    graph = NodeGraph(folder, nodes)
    try:
        for name in (*nodes, "live_view"):
            graph.start(packages[name], name)
        print(f"http://{LOOPBACK}:{options.port}/   (Ctrl-C ends all)", flush=True)
        while not end.requested:
            graph.check()
            wait_for([graph.nodes["console"]], _POLL)
    finally:
        graph.stop()
    shutil.rmtree(folder)
    return EXIT_INTERRUPTED
