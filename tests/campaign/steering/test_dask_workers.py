"""Studies on a real scheduler and real worker processes: the same bits, even if workers die."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from dask_cluster import NEEDED, Cluster
from dying_part import end_every, end_the_first
from needle_bringup.studies.cluster import ClusterPart, digest, on_cluster
from needle_bringup.studies.monte_carlo import main
from needle_bringup.studies.monte_carlo_options import parse
from needle_bringup.studies.study_parts import parts_of
from needle_core.errors import UserError

STUDY = ("--draws", "3", "--depth-mm", "4", "--seed", "5")
PARTS = parts_of(parse(STUDY))


@pytest.fixture(scope="module")
def two_workers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    started = Cluster(tmp_path_factory.mktemp("cluster"), 2)
    yield started
    started.end()


def figures_of(folder: Path, *argv: str) -> tuple[dict[str, object], str]:
    files = ["--json", str(folder / "f.json"), "--csv", str(folder / "f.csv")]
    assert main([*STUDY, *argv, *files]) == 0
    figures = json.loads((folder / "f.json").read_text("utf-8"))
    for key in ("wall_s", "cpu_s"):
        assert figures.pop(key) > 0.0
    return figures, (folder / "f.csv").read_text("utf-8")


@NEEDED
def test_a_cluster_gives_the_figures_of_one_machine(
    two_workers: Cluster, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    alone = figures_of(tmp_path)
    assert figures_of(tmp_path, "--scheduler", two_workers.address) == alone
    assert "warning" not in capfd.readouterr().err


@NEEDED
def test_a_killed_worker_costs_only_time(two_workers: Cluster, tmp_path: Path) -> None:
    asked = [(tmp_path / "killed", ClusterPart(part, PARTS[0].of_first(2))) for part in PARTS]
    done = on_cluster(two_workers.address, end_the_first, asked)
    assert [digest(part.outcomes) for part in done] == [digest(part.run()) for part in PARTS]
    assert (tmp_path / "killed").exists()


@NEEDED
def test_a_part_that_kills_every_worker_is_abandoned(two_workers: Cluster) -> None:
    with pytest.raises(UserError, match=r"workers died while running it.*out of memory"):
        list(on_cluster(two_workers.address, end_every, [None]))
