from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from campaign.checks.control_studies import COMPARED
from campaign.steering.estimator_table import figures, main, steer
from needle_sim.studies.figures_of_merit import Outcomes


def test_the_table_has_every_row_of_the_step() -> None:
    assert {"best", "push_2", "gain_80", "roll_walk_5", "camera", "layer", "found_30"} <= {
        *COMPARED
    }
    assert len(COMPARED) == 25


def test_figures_are_shares_of_the_counted_needles() -> None:
    x = np.array([0.0, 0.002, -0.002, 0.0005])
    nothing, of_each = np.zeros(4), np.ones(4)
    outcomes = Outcomes(
        x_start=nothing,
        x_last=x[:, None],
        settled=nothing,
        rotation=nothing,
        inside_2_sigma=of_each,
        inside_3_sigma=of_each,
        x_inside_3_sigma=of_each,
        missed=np.array([0.06, 1.0, 0.02, 0.0005]),
    )
    row = figures(outcomes)
    assert (row["within"], row["misses"], row["flagged"], row["false_alarms"]) == (0.5, 2, 0.5, 0.5)
    assert row["rms_mm"] == pytest.approx(np.sqrt((8.0 + 0.25) / 4.0))
    needles, stated, misses = row["bins"]
    assert sum(needles) == 4
    assert (needles[0], stated[0], misses[0]) == (1, 0.0005, 0)
    assert (needles[-1], stated[-1], misses[-1]) == (1, 1.0, 1)


@pytest.mark.parametrize("key", ["best", "push_2", "late", "flips"])
def test_the_reference_filter_steers_and_its_estimate_is_accurate(key: str) -> None:
    row = steer(COMPARED[key], "ekf", 1000)
    assert row["within"] > 0.94
    assert row["inside"] > 0.98


def test_the_command_prints_and_writes_the_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["--needles", "1000", "--only", "push_2", "--estimators", "paper"]
    assert main([*argv, "--json", str(tmp_path / "now.json")]) == 0
    row = json.loads((tmp_path / "now.json").read_text("utf-8"))["push_2"]["paper"]
    assert row["within"] > 0.9
    # An estimator that states no probability has no such figures.
    assert "bins" not in row
    assert "paper  push_2           within 0.9" in capsys.readouterr().out
    assert main(["--only", "nothing"]) == 2
    assert "nothing" in capsys.readouterr().err
