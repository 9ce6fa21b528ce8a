from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from needle_bringup.studies.monte_carlo import main
from needle_bringup.studies.monte_carlo_options import parse
from needle_bringup.studies.study_parts import parts_of, results_of

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
    "inside_2_sigma",
    "inside_3_sigma",
    "doubtful_at_end",
    "trusted_far_off",
    "within_1_mm_point",
    "rms_point_mm",
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
    assert figures["inside_2_sigma"] is None
    assert figures["doubtful_at_end"] is None
    assert figures["trusted_far_off"] is None
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


def test_targets_have_figures_of_points_and_none_of_the_plane(tmp_path: Path) -> None:
    files = ["--json", str(tmp_path / "f.json"), "--csv", str(tmp_path / "f.csv")]
    assert main(["--targets", "7", "--depth-mm", "10", *files]) == 0
    figures = json.loads((tmp_path / "f.json").read_text("utf-8"))
    assert set(figures) >= KEYS
    assert figures["runs"] == 7
    assert figures["converged_at_end"] is None
    # 10 mm are not enough for any of them
    assert figures["within_1_mm_point"] == 0.0
    assert figures["missed_runs"] == 7
    # It knows where it is, and says that this is not the point.
    assert figures["doubtful_at_end"] == 1.0
    assert figures["trusted_far_off"] == 0.0
    with (tmp_path / "f.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    error = np.array([float(row["error_mm"]) for row in rows])
    assert figures["rms_point_mm"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-4)
    ahead = [float(row["target_z_mm"]) for row in rows]
    np.testing.assert_allclose(error, np.array(ahead) - 10.0, atol=30.0)
    assert parse(["--targets", "7"]).depth == pytest.approx(0.150)
    assert parse([]).depth == pytest.approx(0.120)


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
        (["--targets", "-1"], "--targets = -1"),
        (["--targets", "5", "--controller", "paper"], "paper cannot steer to a point"),
        (["--outlier-mm", "5"], "--outlier-mm '5'"),
        (["--outlier-mm", "5,2"], "--outlier-mm HI = 2"),
        (["--noise-shape", "round"], "--noise-shape 'round'"),
        (["--noise-lasting", "0.5"], "--noise-shape normal"),
        (["--claimed-mm", "0"], "--claimed-mm = 0"),
        (["--sigma-scale", "0"], "--sigma-scale = 0"),
        (["--slip", "-1"], "--slip = -1"),
        (["--bump-mm", "-2"], "--bump-mm = -2"),
        (["--untold-delay", "1.5"], "--untold-delay"),
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
    names = ("grid", "kappa-patches", "flips", "csv", "noise-shape", "claimed-mm", "untold-delay")
    assert all(f"--{name}" in text for name in names)
    assert np.all([len(line) <= 100 for line in text.splitlines()])


def test_troubles_come_in_si_and_the_claim_is_no_matter_of_the_noise() -> None:
    noise = "--noise-mm 0.58 --noise-shape normal --noise-lasting 0.8 --outlier-mm 2,3.5"
    others = "--slip -0.05 --bump-mm 2 --untold-delay 3 --sigma-scale 2"
    options = parse([*noise.split(), *others.split()])
    found = options.disturbances
    assert found.noise == pytest.approx(0.00058)
    assert (found.noise_shape, found.noise_lasting) == ("normal", 0.8)
    assert found.outlier_size == pytest.approx((0.002, 0.0035))
    assert (found.slip, found.bump, found.untold_delay) == (-0.05, 0.002, 3)
    assert options.claimed_bound == 0.001
    assert options.sigma_scale == 2.0
    assert parse(["--claimed-mm", "0.5"]).claimed_bound == 0.0005


def test_the_default_controller_is_the_best() -> None:
    assert parse([]).controller == "best"


@pytest.mark.parametrize("asked", [["--targets", "11"], ["--controller", "paper", "--draws", "1"]])
def test_a_part_of_a_study_comes_out_as_in_the_whole(asked: list[str]) -> None:
    """Wherever it is cut: so that parts can be steered on many machines."""
    options = parse([*asked, "--depth-mm", "12", "--target-drift-mm", "2", "--play-deg", "10"])
    (whole,) = parts_of(options)
    cut = 4
    rest = dataclasses.replace(
        whole, first=cut, starts=whole.starts[cut:], places=whole.places[cut:]
    )
    parts = [whole.of_first(cut), rest]
    apart = results_of(parts, [part.run() for part in parts])
    together = results_of([whole], [whole.run()])
    assert apart.columns.keys() == together.columns.keys()
    for name, column in together.columns.items():
        np.testing.assert_array_equal(apart.columns[name], column, err_msg=name)
    assert apart.figures == together.figures


def test_an_own_part_that_is_not_there_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["--estimator", "a"], ["--law", "a"], ["--targets", "3", "--planner", "a"]):
        assert main([*words, "--depth-mm", "5"]) == 2
        assert "= 'a': no installed package offers it" in capsys.readouterr().err
    assert main(["--planner", "a"]) == 2
    assert "--planner goes with --targets only" in capsys.readouterr().err
    assert main(["--targets", "3", "--controller", "rrt", "--law", "a"]) == 2
    assert "rrt is a law" in capsys.readouterr().err
