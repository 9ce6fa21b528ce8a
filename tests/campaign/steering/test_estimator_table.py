from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from campaign.checks.control_studies import COMPARED
from campaign.steering.estimator_table import (
    EDGES,
    Row,
    figures,
    main,
    markdown,
    steer,
)
from needle_sim.studies.figures_of_merit import Outcomes

ROW = Row(0.999, 0.15, 0.99, 1, 1.0, 0.02, [(100, 0.5, 1)] * (len(EDGES) - 1), 1200.0, 30.0)
SILENT = dataclasses.replace(ROW, inside=None, called=None, false_alarms=None, bins=[])


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
    row = figures(outcomes, 1.0)
    assert (row.within, row.misses, row.called, row.false_alarms) == (0.5, 2, 0.5, 0.5)
    assert row.rms_mm == pytest.approx(np.sqrt((8.0 + 0.25) / 4.0))
    assert sum(n for n, _, _ in row.bins) == 4
    assert row.bins[0] == (1, 0.0005, 0)
    assert row.bins[-1] == (1, 1.0, 1)


def test_missing_values_are_dashes_in_the_table() -> None:
    text = markdown(
        {"push": {"best": ROW, "paper": SILENT}, "flips": {"best": ROW}}, ["best", "paper"]
    )
    assert "| push | 99.90, 99.90 | 0.15, 0.15 | 99.0 | 1 | 100.0 | 2.0 |" in text
    assert "| flips | 99.90, - |" in text
    assert "| best | 0 to 0.001 | 200 | 0.0050 | 0.0100 |" in text
    assert "| paper | 0" not in text


@pytest.mark.parametrize("key", ["best", "push_2", "late", "flips"])
def test_the_reference_filter_steers_and_its_estimate_is_accurate(key: str) -> None:
    row = steer(COMPARED[key], "ekf", 1000)
    assert row.within > 0.94
    assert row.inside is not None
    assert row.inside > 0.98


def test_the_command_writes_table_and_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--needles", "1000", "--only", "push_2", "--estimators", "paper"]
    figures_file, table = tmp_path / "now.json", tmp_path / "table.md"
    assert main([*words, "--json", str(figures_file), "--table", str(table)]) == 0
    assert json.loads(figures_file.read_text("utf-8"))["push_2"]["paper"]["within"] > 0.9
    assert "| push_2 | 9" in table.read_text(encoding="utf-8")
    assert main(["--only", "nothing"]) == 2
    assert "nothing" in capsys.readouterr().err
