"""Runs on a cluster of real workers: those of one machine, whoever dies."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from dask_cluster import NEEDED, Cluster
from dying_part import end_the_first_soak
from needle_bringup.studies.cluster import on_cluster
from scenario.many_runs import results_of_cluster, run_part
from scenario.rig_run import RunResult

SEEDS = range(4, 6)


def without_log(results: list[RunResult]) -> list[RunResult]:
    """Return results but for what their nodes said: it has the process' number."""
    return [dataclasses.replace(one, log=()) for one in results]


@NEEDED
def test_a_cluster_gives_the_runs_of_one_machine(tmp_path: Path) -> None:
    alone = without_log(run_part(SEEDS))
    assert all(one.digest for one in alone)
    started = Cluster(tmp_path, 2)
    try:
        assert without_log(list(results_of_cluster(started.address, SEEDS))) == alone
        # A killed worker costs only time.
        asked = [(tmp_path / "killed", SEEDS[:1]), (tmp_path / "killed", SEEDS[1:])]
        done = on_cluster(started.address, end_the_first_soak, asked)
        assert without_log([one for part in done for one in part]) == alone
        assert (tmp_path / "killed").exists()
    finally:
        started.end()
