"""No process is left when a node or its parent ends."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path

from needle_bringup.simulation.node_graph import NodeProcess, stop, wait_for


def test_children_of_a_node_end_with_it(tmp_path: Path) -> None:
    code = """
import subprocess, sys
print(subprocess.Popen(["sleep", "1000"]).pid, flush=True)
sys.exit(3)
"""
    command = [sys.executable, "-c", code]
    process = NodeProcess("node", command, environment=os.environ, log=tmp_path / "node.log")
    wait_for([process], 10.0)
    child = int(process.last_line)
    assert "exit code 3" in process.describe_end()
    stop([process])
    assert_ends(child)


def test_a_node_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    code = """
import os, sys, time
from pathlib import Path
from needle_bringup.simulation.node_graph import NodeProcess
node = NodeProcess("n", ["sleep", "1000"], environment=os.environ, log=Path(sys.argv[1]))
print(node.pid, flush=True)
time.sleep(1000)
"""
    command = [sys.executable, "-c", code, str(tmp_path / "log")]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    parent.stdout.close()
    assert_ends(child)


def assert_ends(pid: int) -> None:
    """Wait until a process has ended or is a zombie."""
    with contextlib.suppress(OSError):
        while "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]:
            wait_for([], 0.0)
