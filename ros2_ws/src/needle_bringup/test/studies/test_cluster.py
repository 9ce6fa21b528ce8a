"""Studies on a simulated cluster: identical, ordered results despite lost workers."""

from __future__ import annotations

import json
import socket
import sys
import types
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from needle_bringup.studies import cluster
from needle_bringup.studies.cluster import on_cluster
from needle_bringup.studies.monte_carlo import main
from needle_core.errors import UserError

ADDRESS = "tcp://10.0.0.5:8786"


class LostConnection(Exception):
    pass


class KilledWorker(Exception):
    pass


class Future:
    """Part that is computed when its result is requested."""

    def __init__(self, work: Callable[[], Any]) -> None:
        self.result = work


class Dask(types.ModuleType):
    """Stand-in for `distributed`: computes the parts here, until the connection is lost."""

    KilledWorker, CancelledError = KilledWorker, LostConnection

    def __init__(self) -> None:
        super().__init__("distributed")
        self.answers = True
        self.lost_at: int | None = None
        """Number of the part at which the connection is lost."""

    def Client(self, address: str, timeout: float) -> Dask:
        assert address == ADDRESS
        if not self.answers:
            raise OSError("Timed out\nafter 30 s")
        return self

    def __enter__(self) -> Dask:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def map(self, run: Callable[[Any], Any], parts: Sequence[Any], **__: object) -> list[Future]:
        def result(number: int, part: Any) -> Any:
            if number == self.lost_at:
                raise LostConnection("connection lost")
            return run(part)

        return [Future(partial(result, n, part)) for n, part in enumerate(parts)]


@pytest.fixture
def dask(monkeypatch: pytest.MonkeyPatch) -> Dask:
    module = Dask()
    monkeypatch.setitem(sys.modules, "distributed", module)
    return module


def square(number: int) -> int:
    if number < 0:
        raise KilledWorker("killed 3 times")
    return number**2


def test_results_are_in_the_order_of_the_parts(dask: Dask) -> None:
    assert list(on_cluster(ADDRESS, square, range(5))) == [0, 1, 4, 9, 16]


def test_cluster_errors_are_one_line(dask: Dask, monkeypatch: pytest.MonkeyPatch) -> None:
    def refusal(*parts: int, address: str = ADDRESS) -> str:
        with pytest.raises(UserError) as error:
            list(on_cluster(address, square, parts))
        return str(error.value)

    assert "(out of memory? see their logs)" in refusal(-1)
    dask.lost_at = 1
    assert refusal(1, 2) == f"--scheduler {ADDRESS}: connection lost"
    dask.answers = False
    assert refusal(1) == f"--scheduler {ADDRESS}: Timed out after 30 s"
    for address in ("somewhere", "gopher://a:1", "tcp://a", "tcp://a:b"):
        assert "is not tcp://HOST:PORT" in refusal(address=address)
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "scripts/dask --version installs it" in refusal(1)


def test_a_worker_with_different_code_is_rejected(
    dask: Dask, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = cluster.identity("needle_sim")
    known = iter([{**here, "numpy": "1.0.0"}, here])
    monkeypatch.setattr(cluster, "identity", lambda _: next(known))
    with pytest.raises(UserError, match=r"has numpy \S+ instead of 1\.0\.0; all machines"):
        list(on_cluster(ADDRESS, square, [1]))


def figures_of(folder: Path, *argv: str) -> tuple[Mapping[str, object], str]:
    study = ["--targets", "3", "--depth-mm", "2", "--json", str(folder / "f.json")]
    assert main([*study, "--csv", str(folder / "f.csv"), *argv]) == 0
    figures = json.loads((folder / "f.json").read_text("utf-8"))
    for key in ("wall_s", "cpu_s"):
        assert figures.pop(key) > 0.0
    return figures, (folder / "f.csv").read_text("utf-8")


def test_a_cluster_gives_the_figures_of_one_machine(
    dask: Dask, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    figures, runs = figures_of(tmp_path)
    there = figures_of(tmp_path, "--scheduler", ADDRESS)
    assert there == (figures, runs)
    assert "warning" not in capsys.readouterr().err
    monkeypatch.setattr(cluster, "_witness_digest", lambda _: "other bits")
    figures_of(tmp_path, "--scheduler", ADDRESS)
    assert f"warning: {socket.gethostname()} rounds unlike" in capsys.readouterr().err
