from __future__ import annotations

import json
from pathlib import Path

import pytest

from campaign.steering.estimator_table import main


def test_the_table_has_the_figures_of_each_estimator(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["--needles", "1000", "--only", "push_2,late", "--estimators", "ekf,paper"]
    assert main([*argv, "--json", str(tmp_path / "now.json")]) == 0
    for row in json.loads((tmp_path / "now.json").read_text("utf-8")).values():
        assert row["ekf"]["within"] > 0.94
        assert row["ekf"]["inside"] > 0.98
        assert sum(row["ekf"]["bins"][0]) == 1000
        # An estimator that states no probability has no such figures.
        assert row["paper"]["within"] > 0.9
        assert "bins" not in row["paper"]
    assert "paper  push_2           within 0.9" in capsys.readouterr().out
    assert main(["--only", "nothing"]) == 2
