from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from needle_verification.studies.monte_carlo import main
from needle_verification.studies.monte_carlo_options import parse

KEYS = {
    "runs",
    "converged_at_end",
    "converged_last_20",
    "rms_last_20_mm",
    "p95_last_20_mm",
    "max_last_20_mm",
    "settle_median_mm",
    "settle_p95_mm",
    "rotation_mean_deg",
    "wall_s",
}


def test_open_loop_s_known_answer_in_json_and_csv(tmp_path: Path) -> None:
    files = ["--json", str(tmp_path / "f.json"), "--csv", str(tmp_path / "f.csv")]
    start = ["--initial", "-3,2,15", "--draws", "1"]
    assert main(["--controller", "open_loop", *start, *files]) == 0
    figures = json.loads((tmp_path / "f.json").read_text("utf-8"))
    assert set(figures) >= KEYS
    assert figures["runs"] == 1000
    assert figures["converged_at_end"] == 0.0
    assert figures["final_max_mm"] == pytest.approx(14.62, abs=0.005)
    assert figures["settle_median_mm"] is None
    assert figures["rotation_mean_deg"] == 0.0
    with (tmp_path / "f.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 1000
    assert float(rows[0]["r1_final_mm"]) == pytest.approx(14.62, abs=0.005)
    assert rows[0]["settle_mm"] == ""


def test_the_same_seed_gives_the_same_figures(tmp_path: Path) -> None:
    seen = []
    for seed in ("1", "1", "2"):
        path = tmp_path / "figures.json"
        arguments = ["--controller", "paper", "--draws", "1", "--depth-mm", "30", "--seed", seed]
        assert main([*arguments, "--json", str(path)]) == 0
        figures = json.loads(path.read_text("utf-8"))
        times = ("wall_s", "cpu_s")
        seen.append({key: value for key, value in figures.items() if key not in times})
    assert seen[0] == seen[1]
    assert seen[0]["rms_last_20_mm"] != seen[2]["rms_last_20_mm"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--controller", "nobody"], "nobody"),
        (["--controller", "paper", "--grid", "hexagonal"], "hexagonal"),
        (["--controller", "paper", "--draws", "0"], "--draws = 0"),
        (["--controller", "paper", "--draws", "1.5"], "--draws"),
        (["--controller", "paper", "--noise-mm", "-1"], "--noise-mm = -1"),
        (["--controller", "paper", "--noise-mm", "nan"], "nan"),
        (["--controller", "paper", "--depth-mm", "inf"], "inf"),
        (["--controller", "paper", "--depth-mm", "0"], "--depth-mm = 0"),
        (["--controller", "paper", "--roll-deg", "181"], "--roll-deg = 181"),
        (["--controller", "paper", "--kappa-scale", "0"], "--kappa-scale = 0"),
        (["--controller", "paper", "--outliers", "5"], "--outliers = 5"),
        (["--controller", "paper", "--dropped", "x"], "'x'"),
        (["--controller", "paper", "--delay", "-1"], "--delay = -1"),
        (["--controller", "paper", "--flips", "3"], "flip"),
        (["--controller", "paper", "--seed", "-1"], "--seed = -1"),
        (["--controller", "paper", "--initial", "1,2"], "--initial"),
        (["--controller", "paper", "--json", "/nowhere/f.json"], "/nowhere/f.json"),
        (["--controller", "paper", "--frobnicate"], "--frobnicate"),
    ],
)
def test_bad_arguments_are_one_line_and_exit_2(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.strip().splitlines()) == 1
    assert said in captured.err


def test_help_names_every_option(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["--help"])
    assert end.value.code == 0
    text = capsys.readouterr().out
    assert all(f"--{name}" in text for name in ("grid", "kappa-patches", "flips", "csv"))
    assert np.all([len(line) <= 100 for line in text.splitlines()])


def test_the_default_controller_is_the_best() -> None:
    assert parse([]).controller == "best"
