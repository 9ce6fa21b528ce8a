"""A Dask cluster on this machine: a scheduler and workers, each a process."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

NEEDED = pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None,
    reason="the cluster's lock is not installed: scripts/dask",
)
_SHARED = Path(__file__).resolve().parent
_ENDS = 60.0


class Cluster:
    """A scheduler and its workers on this machine."""

    def __init__(self, folder: Path, workers: int) -> None:
        # Workers import `dying_part` from this folder.
        paths = os.pathsep.join([str(_SHARED), os.environ.get("PYTHONPATH", "")])
        self._environment = {**os.environ, "PYTHONPATH": paths}
        self.scheduler = self._start(
            subprocess.PIPE, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"
        )
        assert self.scheduler.stderr is not None
        lines = iter(self.scheduler.stderr.readline, "")
        self.address = next(line.split()[-1] for line in lines if "Scheduler at:" in line)
        self.workers = self._start(
            subprocess.DEVNULL, "worker", self.address, "--nworkers", str(workers),
            "--nthreads", "1", "--no-dashboard", "--local-directory", str(folder),
        )  # fmt: skip

    def _start(self, errors: int, *argv: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "dask", *argv]
        return subprocess.Popen(command, env=self._environment, stderr=errors, text=True)

    def end(self) -> None:
        """End the workers, then the scheduler."""
        for process in (self.workers, self.scheduler):
            process.terminate()
            process.wait(_ENDS)
        assert self.scheduler.stderr is not None
        self.scheduler.stderr.close()
