"""Every node as a process: it starts, is discovered, and ends on a signal."""

from __future__ import annotations

import importlib.util
import os
import signal
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node

from code_lines import ROOT
from needle_bringup.simulation.node_graph import NodeProcess, stop, wait_for
from needle_core.commands.cli import EXIT_DONE, EXIT_INTERRUPTED
from needle_core.files.installed import find_executable
from needle_tracker.optics.calibration import SIDES
from reference.rig_nodes import REGISTRATION, executables

TIMEOUT = 60.0  # [s]
# Packages that the environment may lack.
EXTRAS = {"console": "nicegui", "openigtlink": "pyigtl"}


@pytest.fixture
def listener() -> Iterator[Node]:
    """Yield a node in the graph of the tested nodes."""
    context = Context()
    rclpy.init(context=context)
    node = rclpy.create_node("listener", context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


def words(name: str, folder: Path) -> list[str]:
    """Return the required parameters of a node, and its own namespace."""
    parameters = {
        "device_driver": ["link:=slcan", f"channel:={folder / 'can'}", "connect_timeout:=60.0"],
        "drive_emulator": [f"pty:={folder / 'can'}"],
        "operator": ["source:=joy", "key:=0"],
        "recorder": [f"bag:={folder / 'bag'}"],
        "stereo_camera": [f"{side}:={folder / side}" for side in SIDES] + ["loop:=true"],
        "tracked_tip": [f"registration_file:={REGISTRATION}"],
    }
    if name == "player":
        return [str(ROOT / "bags" / "regression"), "--loop"]
    given = [word for parameter in parameters.get(name, ()) for word in ("-p", parameter)]
    return ["--ros-args", "-r", f"__ns:=/of_{name}", *given]


def awaited(condition: Callable[[], bool]) -> bool:
    """Return whether a condition holds before the time-out."""
    until = time.monotonic() + TIMEOUT
    while not condition() and time.monotonic() < until:
        time.sleep(0.1)
    return condition()


def run_until_sigterm(names: Collection[str], folder: Path, listener: Node) -> None:
    """Start nodes, end them once the listener has discovered all, and check how they ended."""
    nodes = [
        NodeProcess(
            name,
            [find_executable(package, name), *words(name, folder)],
            environment=os.environ,
            log=folder / f"{name}.log",
        )
        for package, name, _ in executables("node")
        if name in names and importlib.util.find_spec(EXTRAS.get(name, "rclpy"))
    ]
    started = {node.name for node in nodes}
    try:
        awaited(lambda: started <= set(listener.get_node_names()))
        assert started - set(listener.get_node_names()) == set()
        for node in nodes:
            node.signal_group(signal.SIGTERM)
        assert [node.name for node in wait_for(nodes, TIMEOUT)] == []
    finally:
        stop(nodes)
    for node in nodes:
        assert node.exit_code in (EXIT_DONE, EXIT_INTERRUPTED), node.describe_end()
        assert "Traceback" not in "".join(node.tail(1000))


def test_every_node_starts_is_discovered_and_ends_on_sigterm(
    tmp_path: Path, listener: Node
) -> None:
    for side in SIDES:
        (tmp_path / side).mkdir()
        cv2.imwrite(str(tmp_path / side / "1.png"), np.zeros((768, 1024), np.uint8))
    names = {name for _, name, _ in executables("node")}
    # The player ends as soon as it discovers a rig.
    run_until_sigterm({"player"}, tmp_path, listener)
    run_until_sigterm(names - {"player"}, tmp_path, listener)
