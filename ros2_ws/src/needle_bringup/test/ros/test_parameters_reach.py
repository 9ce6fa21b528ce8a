"""No node runs on its defaults where a parameter file was written for it."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

import pytest

from code_lines import ROOT
from needle_core.files.installed import find_executable
from needle_core.settings.parameter_files import NODES
from reference.rig_nodes import executables

MODULES = {name: module for _, name, module in executables("node")}
BAG = str(ROOT / "bags" / "regression")
# What a node wants before `--ros-args`.
WORDS = {"player": [BAG]}
# What the checkout's environment need not have.
EXTRAS = {"console": "nicegui", "openigtlink": "pyigtl"}


def test_every_node_is_known() -> None:
    assert set(MODULES) == set(NODES)


@pytest.mark.parametrize("node", MODULES)
@pytest.mark.parametrize(
    ("remapping", "name"), [("__ns:=/rig1", "/rig1/{}"), ("__node:=other", "/other")]
)
def test_a_node_that_its_section_does_not_reach_stops(
    node: str,
    remapping: str,
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip(EXTRAS.get(node, "rclpy"))
    file = tmp_path / "rig.yaml"
    file.write_text(f"{node}: {{ros__parameters: {{}}}}")
    words = [*WORDS.get(node, []), "--ros-args", "--params-file", str(file), "-r", remapping]
    # Without the line, it would stop for this.
    words += ["-p", "unknown:=1"]
    monkeypatch.setattr(sys, "argv", [f"/lib/{node}", *words])
    with mock.patch.dict(os.environ):
        assert importlib.import_module(MODULES[node]).main() == 2
    line = f"error: {file}: section '{node}' is for /{node}, this node is {name.format(node)}: "
    assert capsys.readouterr().err.startswith(line)


@pytest.mark.parametrize(
    ("section", "reached"), [("/rig1/device_driver", True), ("device_driver", False)]
)
def test_drives_of_another_rig_reach_the_driver_in_its_namespace_or_stop_it(
    section: str, reached: bool, tmp_path: Path
) -> None:
    file = tmp_path / "drives.yaml"
    shipped = ROOT / "ros2_ws/src/needle_device_driver/config/drives.yaml"
    text = shipped.read_text("utf-8").replace("\ndevice_driver:", f"\n{section}:")
    file.write_text(text.replace("max_depth: 0.2 ", "max_depth: 9.0 "))
    command = [find_executable("needle_device_driver", "device_driver"), "--ros-args"]
    command += ["-r", "__ns:=/rig1", "--params-file", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)
    assert done.returncode == 2
    # A depth that no driver takes shows that it has come.
    expected = (
        "error: /rig1/device_driver: max_depth = 9.0 is outside"
        if reached
        else (
            f"error: {file}: section 'device_driver' is for /device_driver, this node is "
            "/rig1/device_driver: write '/rig1/device_driver', '/**/device_driver' or '/**'"
        )
    )
    assert done.stderr.splitlines()[0].startswith(expected)
