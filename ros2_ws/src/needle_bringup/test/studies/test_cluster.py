"""Studies on a simulated cluster: identical, ordered results despite lost workers."""

from __future__ import annotations

import json
import socket
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
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

    def __init__(self, key: str, work: Callable[[], Any]) -> None:
        self.key, self.result = key, work

    def release(self) -> None:
        pass


class Dask(types.ModuleType):
    """Stand-in for `distributed`: computes parts here, last first, until a connection is lost."""

    KilledWorker, CancelledError = KilledWorker, LostConnection

    def __init__(self) -> None:
        super().__init__("distributed")
        self.answers = True
        self.lost_after: list[int] = []
        """Number of parts after which each connection is lost."""
        self.asked: list[int] = []

    def Client(self, address: str, timeout: float) -> Dask:
        assert address == ADDRESS
        if not self.answers:
            raise OSError("Timed out\nafter 30 s")
        return self

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        pass

    def as_completed(self, futures: Sequence[Future]) -> Iterator[Future]:
        self.asked.append(len(futures))
        left = self.lost_after.pop(0) if self.lost_after else len(futures)
        return self._done(list(reversed(futures)), left)

    def _done(self, ready: Sequence[Future], left: int) -> Iterator[Future]:
        yield from ready[:left]
        if left < len(ready):
            raise LostConnection


@pytest.fixture
def dask(monkeypatch: pytest.MonkeyPatch) -> Dask:
    module = Dask()

    def submit(
        _: Dask, run: Callable[[Any], Any], parts: Sequence[Any], **__: object
    ) -> list[Future]:
        return [Future(f"{n}", partial(run, part)) for n, part in enumerate(parts)]

    monkeypatch.setattr(Dask, "map", submit, raising=False)
    monkeypatch.setitem(sys.modules, "distributed", module)
    return module


def square(number: int) -> int:
    if number < 0:
        raise KilledWorker("killed 3 times")
    return number**2


def test_results_keep_the_order_of_the_parts_after_a_lost_connection(dask: Dask) -> None:
    assert list(on_cluster(ADDRESS, square, range(5))) == [0, 1, 4, 9, 16]
    dask.lost_after = [2, 1]
    assert list(on_cluster(ADDRESS, square, range(5))) == [0, 1, 4, 9, 16]
    assert dask.asked == [5, 5, 3, 2]


def test_cluster_errors_are_one_line(dask: Dask, monkeypatch: pytest.MonkeyPatch) -> None:
    def refusal(*parts: int, address: str = ADDRESS) -> str:
        with pytest.raises(UserError) as error:
            list(on_cluster(address, square, parts))
        return str(error.value)

    assert "(out of memory? see their logs)" in refusal(-1)
    dask.lost_after = [0]
    assert refusal(1, 2).endswith("lost, with 0 of 2 parts done")
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


def figures_of(folder: Path, *words: str) -> tuple[Mapping[str, object], str]:
    study = ["--targets", "3", "--depth-mm", "2", "--json", str(folder / "f.json")]
    assert main([*study, "--csv", str(folder / "f.csv"), *words]) == 0
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
