"""The paper's page, figures and --json, of runs whose figures are known."""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from needle_bags.reading.bag_reader import Run, read_run
from needle_bringup.paper import paper_results, paper_runs
from needle_bringup.paper.paper import main
from needle_bringup.paper.paper_runs import Columns, Laboratory
from needle_bringup.studies.limit_study import LimitRow, Reached
from needle_bringup.workplace import checkout
from needle_core.commands.cli import JsonValue

COUNT = 400
FIGURES: dict[str, JsonValue] = {
    "runs": COUNT,
    "converged_at_end": 0.99,
    "converged_last_20": 0.985,
    "settle_median_mm": 41.0,
}


@functools.cache
def a_run() -> Run:
    return read_run(checkout() / "bags" / "regression")


class MadeUpLaboratory(Laboratory):
    """Every trial is one bag, and every study the same runs: four miss, and farther in one."""

    def trial(self, name: str, *arguments: str) -> Run:
        return a_run()

    def study(self, name: str, *arguments: str) -> tuple[dict[str, JsonValue], Columns]:
        rng = np.random.default_rng(0)
        columns = {
            "x_mm": rng.uniform(-20.0, 20.0, COUNT),
            "pitch_deg": rng.uniform(-40.0, 40.0, COUNT),
            "roll_deg": rng.uniform(-90.0, 90.0, COUNT),
            "r1_final_mm": rng.uniform(-0.9, 0.9, COUNT),
        }
        columns["r1_final_mm"][:4] = 0.5 if "240" in arguments else 1.5
        columns["r1_final_mm"][0] = -2.0
        return FIGURES, columns

    def identify(self, name: str, bag: str, *arguments: str) -> dict[str, JsonValue]:
        return {"radius_mm": 121.0, "radius_low_mm": 118.5, "radius_high_mm": 124.5}


def test_the_page_has_the_paper_s_values_beside_those_of_the_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    row = LimitRow(Reached(0.14, 0.2, 0.999), Reached(0.11, 0.15, 1.0))
    monkeypatch.setattr(paper_runs, "Laboratory", MadeUpLaboratory)
    monkeypatch.setattr(paper_results, "limits", lambda *_: {"noise ±1 mm": row})
    file = tmp_path / "figures.json"
    assert main(["--quick", "--out", str(tmp_path / "out"), "--json", str(file)]) == 0
    page = (tmp_path / "out" / "paper.md").read_text("utf-8")
    for cells in (
        "endpoint grid: within ±1 mm at 120 mm",
        "| 98.56 % | 99.00 % / 98.50 % |",
        "| 144 of 10,000; none diverged | 4 of 400; 3 of them within ±1 mm at 240 mm, the worst 2",
        "| 12.2 cm | 12.10 cm (95 %: 118.5 to 124.5 mm) |",
        "0.14 mm, 0.20 mm, 99.9 %; limit 0.11 mm, 0.15 mm, 100.0 %",
    ):
        assert cells in page
    assert "98.56 %" in capsys.readouterr().out
    images = sorted((tmp_path / "out" / "images").glob("*.png"))
    assert [f"images/{image.name}" in page for image in images] == [True] * 4
    for path in images:
        image = cv2.imread(str(path))
        assert image is not None
        assert np.ptp(image) > 200
    values = json.loads(file.read_text())
    assert (values["endpoint_missed"], values["endpoint_missed_also_later"]) == (4, 1)
    assert values["limit_noise_1_mm_point_rms_mm"] == 0.15
    assert all(math.isfinite(value) for value in values.values())
