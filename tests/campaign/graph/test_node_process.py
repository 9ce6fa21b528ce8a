"""Nodes as processes: whatever they do about signals, and whoever is killed, none is left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

from needle_bringup.simulation.node_process import NodeProcess, stop, wait_for


def start(tmp_path: Path, script: str) -> NodeProcess:
    """Start a Python script and wait until it has said that it runs."""
    process = NodeProcess(
        "node",
        [sys.executable, "-c", textwrap.dedent(script)],
        environment=os.environ,
        log=tmp_path / "node.log",
    )
    while process.exit_code is None and process.last_line != "runs":
        wait_for([process], 0.01)
    return process


def test_an_orderly_node_ends_on_sigint(tmp_path: Path) -> None:
    process = start(
        tmp_path,
        """
        import signal, sys
        signal.signal(signal.SIGINT, lambda *_: sys.exit(0))
        print("runs", flush=True)
        signal.pause()
        """,
    )
    assert stop([process]) == []
    assert process.exit_code == 0


def test_a_stubborn_node_is_killed_and_named(tmp_path: Path) -> None:
    process = start(
        tmp_path,
        """
        import signal, time
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, lambda *_: print("no", flush=True))
        print("runs", flush=True)
        time.sleep(1000)
        """,
    )
    warnings = stop([process], grace=0.1)
    assert process.exit_code == -signal.SIGKILL
    assert ["node" in warning for warning in warnings] == [True]


def test_what_a_node_started_ends_with_it(tmp_path: Path) -> None:
    process = start(
        tmp_path,
        """
        import subprocess, sys
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"])
        print(child.pid, flush=True)
        print("runs", flush=True)
        sys.exit(3)
        """,
    )
    wait_for([process], 10.0)
    child = int(process.tail(2)[0])
    assert "exit code 3" in process.describe_end()
    stop([process])
    while Path(f"/proc/{child}").exists() and "Z" not in _state(child):
        wait_for([], 0.0)


def test_a_node_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    parent = subprocess.Popen(
        [
            sys.executable,
            "-c",
            textwrap.dedent(
                """
                import os, sys, time
                from pathlib import Path
                from needle_bringup.simulation.node_process import NodeProcess
                node = NodeProcess("n", ["sleep", "1000"], environment=os.environ,
                                   log=Path(sys.argv[1]))
                print(node._process.pid, flush=True)
                time.sleep(1000)
                """
            ),
            str(tmp_path / "log"),
        ],
        stdout=subprocess.PIPE,
    )
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    parent.stdout.close()
    while Path(f"/proc/{child}").exists() and "Z" not in _state(child):
        wait_for([], 0.0)


def _state(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "Z"
