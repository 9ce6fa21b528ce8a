"""`paper`: numbers of known runs, page, figures, --json and command line."""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from needle_bags.reading.bag_reader import Run, read_run
from needle_bringup.paper import paper_results
from needle_bringup.paper.paper import main
from needle_bringup.paper.paper_results import (
    Columns,
    Laboratory,
    settled_mm,
)
from needle_bringup.workplace import checkout
from needle_core.commands.cli import JsonValue

COUNT = 400
FIGURES: dict[str, JsonValue] = {
    "runs": COUNT,
    "converged_at_end": 0.99,
    "converged_last_20": 0.985,
    "settle_median_mm": 41.0,
}


def test_settled_is_the_last_entry_into_the_band() -> None:
    insertion = np.arange(6.0)
    assert settled_mm(insertion, np.array([3.0, 2.0, 0.5, 1.5, 1.0, 0.0])) == 4.0
    assert settled_mm(insertion, np.zeros(6)) == 0.0
    assert settled_mm(insertion, np.full(6, 2.0)) == np.inf


@functools.cache
def committed_run() -> Run:
    return read_run(checkout() / "bags" / "regression")


class MadeUpLaboratory(Laboratory):
    """Laboratory whose trials are all one bag, and whose studies have the same runs."""

    def trial(self, name: str, *arguments: str) -> Run:
        return committed_run()

    def study(self, name: str, *arguments: str) -> tuple[dict[str, JsonValue], Columns]:
        rng = np.random.default_rng(0)
        columns = {
            "x_mm": rng.uniform(-20.0, 20.0, COUNT),
            "pitch_deg": rng.uniform(-40.0, 40.0, COUNT),
            "roll_deg": rng.uniform(-90.0, 90.0, COUNT),
            "r1_final_mm": rng.uniform(-0.9, 0.9, COUNT),
        }
        columns["r1_final_mm"][:4] = 0.5 if "240" in arguments else 1.5
        # Had not missed before: its later part does not count.
        columns["r1_final_mm"][4] = 3.0 if "240" in arguments else 0.5
        columns["r1_final_mm"][0] = -2.0
        return FIGURES, columns

    def identify(self, trial: str, *arguments: str) -> dict[str, JsonValue]:
        return {"radius_mm": 121.0, "radius_low_mm": 118.5, "radius_high_mm": 124.5}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder with the output of `paper` for made-up runs."""
    folder = tmp_path_factory.mktemp("paper")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper_results, "Laboratory", MadeUpLaboratory)
        argv = ["--quick", "--out", str(folder / "out"), "--json", str(folder / "figures.json")]
        assert main(argv) == 0
    return folder


def test_the_page_has_both_values(written: Path) -> None:
    page = (written / "out" / "paper.md").read_text("utf-8")
    for cells in (
        "endpoint grid: within ±1 mm at 120 mm",
        "| 98.56 % | 99.00 % / 98.50 % |",
        "| 144 of 10,000; none diverged | 4 of 400; 3 of them within ±1 mm at 240 mm, the worst 2",
        "| 12.2 cm | 12.10 cm (95 %: 118.5 to 124.5 mm) |",
    ):
        assert cells in page
    images = sorted((written / "out" / "images").glob("*.png"))
    assert [f"images/{image.name}" in page for image in images] == [True] * 4
    for path in images:
        image = cv2.imread(str(path))
        assert image is not None
        assert np.ptp(image) > 200
    values = json.loads((written / "figures.json").read_text())
    assert (values["endpoint_missed"], values["endpoint_missed_also_later"]) == (4, 1)
    assert all(math.isfinite(value) for value in values.values())
