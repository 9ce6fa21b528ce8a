"""`monte_carlo`: its figures, files and command line."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from needle_bringup.studies.monte_carlo import main
from needle_bringup.studies.monte_carlo_options import parse
from needle_bringup.studies.study_parts import parts_of, results_of

pytestmark = pytest.mark.usefixtures("compiled")
KEYS = {
    *("runs", "converged_at_end", "converged_last_20", "rms_last_20_mm", "p95_last_20_mm"),
    *("max_last_20_mm", "settle_median_mm", "settle_p95_mm", "rotation_mean_deg", "wall_s"),
    *("inside_2_sigma", "inside_3_sigma", "doubtful_at_end", "trusted_far_off"),
    *("within_1_mm_point", "rms_point_mm"),
}
# Invalid arguments, and the part that the error names.
REFUSED = (
    ("--controller nobody", "nobody"),
    ("--grid hexagonal", "hexagonal"),
    ("--draws 0", "--draws = 0"),
    ("--noise-mm nan", "nan"),
    ("--noise-shape round", "--noise-shape 'round'"),
    ("--correlated 1", "--correlated = 1"),
    ("--student 3", "--student '3' is not DOF,SCALE_MM"),
    ("--student 0.5,1", "--student DOF = 0.5"),
    ("--student 3,21", "--student SCALE_MM = 21"),
    ("--bias-walk 21", "--bias-walk = 21"),
    ("--bias-walk 1 --student 3,1", "--student and --bias-walk are alternative"),
    ("--correlated 0.5 --noise-shape normal", "--correlated and --noise-shape normal are"),
    ("--bias-walk 1 --noise-mm 2", "--noise-mm cannot be combined"),
    ("--push -1", "--push = -1"),
    ("--rotation-gain 2.1", "--rotation-gain = 2.1"),
    ("--roll-walk 91", "--roll-walk = 91"),
    ("--layer 0.3", "--layer '0.3' is not S,FROM_MM"),
    ("--layer 0.01,60", "--layer S = 0.01"),
    ("--layer 0.3,-1", "--layer FROM_MM = -1"),
    ("--step-mm 0", "--step-mm = 0"),
    ("--target-drift-mm-per-s 11", "--target-drift-mm-per-s = 11"),
    ("--outliers 5", "--outliers = 5"),
    ("--outlier-mm 5", "--outlier-mm '5'"),
    ("--outlier-mm 5,2", "--outlier-mm HI = 2"),
    ("--found 1.1", "--found = 1.1"),
    ("--delay -1", "--delay = -1"),
    ("--untold-delay 1.5", "--untold-delay"),
    ("--depth-mm 0", "--depth-mm = 0"),
    ("--roll-deg 181", "--roll-deg = 181"),
    ("--kappa-scale 0", "--kappa-scale = 0"),
    ("--claimed-mm 0", "--claimed-mm = 0"),
    ("--sigma-scale 0", "--sigma-scale = 0"),
    ("--slip -1", "--slip = -1"),
    ("--bump-mm -2", "--bump-mm = -2"),
    ("--initial 1,2", "--initial"),
    ("--controller paper --flips 3", "flip"),
    ("--targets -1", "--targets = -1"),
    ("--targets 5 --controller paper", "paper cannot steer to a point"),
    ("--targets 5 --turn-delay-mm 0.5", "--turn-delay-mm is for needles"),
    ("--targets 3 --controller rrt --law a", "rrt is a law"),
    ("--planner a", "--planner applies to --targets only"),
    ("--estimator a", "= 'a': no installed package provides it"),
    ("--seed -1", "--seed = -1"),
    ("--json /nowhere/f.json", "/nowhere/f.json"),
)


def study(folder: Path, command_line: str) -> tuple[dict[str, Any], list[dict[str, str]]]:
    """Run a study; return its figures and its runs."""
    files = ["--json", str(folder / "f.json"), "--csv", str(folder / "f.csv")]
    assert main([*command_line.split(), *files]) == 0
    with (folder / "f.csv").open(encoding="utf-8") as stream:
        return json.loads((folder / "f.json").read_text("utf-8")), list(csv.DictReader(stream))


def test_the_known_result_of_open_loop_is_in_json_and_csv(tmp_path: Path) -> None:
    command_line = "--controller open_loop --initial -3,2,15 --draws 1 --slip 0.0 --seed 5"
    figures, rows = study(tmp_path, command_line)
    assert set(figures) >= KEYS
    assert (figures["runs"], figures["converged_at_end"]) == (1000, 0.0)
    assert figures["final_max_mm"] == pytest.approx(14.62, abs=0.005)
    assert figures["rotation_mean_deg"] == 0.0
    for key in ("settle_median_mm", "inside_2_sigma", "doubtful_at_end", "trusted_far_off"):
        assert figures[key] is None
    assert [row["run"] for row in rows] == [str(number) for number in range(1000)]
    assert float(rows[0]["r1_final_mm"]) == pytest.approx(14.62, abs=0.005)
    assert rows[0]["settle_mm"] == ""
    # Each row contains its settings, so that files of several studies can be joined.
    for name, value in {"slip": "0.0", "seed": "5", "controller": "open_loop"}.items():
        assert rows[0][name] == value
    assert rows[0]["rotation_deg"] != rows[0]["most_rotation_deg"] == "1e6"


def test_the_same_seed_gives_the_same_figures(tmp_path: Path) -> None:
    command_line = "--controller paper --draws 1 --depth-mm 25 --seed "
    one, again, other = (study(tmp_path, command_line + seed)[0] for seed in ("1", "1", "2"))
    assert one["rms_last_20_mm"] == again["rms_last_20_mm"] != other["rms_last_20_mm"]


@pytest.mark.parametrize("law", ["best", "sliding_mode", "rrt"])
def test_targets_have_figures_of_points_and_none_of_the_plane(tmp_path: Path, law: str) -> None:
    figures, rows = study(tmp_path, f"--targets 4 --depth-mm 8 --controller {law}")
    assert set(figures) >= KEYS
    assert (figures["runs"], figures["converged_at_end"]) == (4, None)
    # 8 mm are too short for all of them
    assert (figures["within_1_mm_point"], figures["missed_runs"]) == (0.0, 4)
    # The controller knows its position, and reports that it missed the point.
    assert (figures["doubtful_at_end"], figures["trusted_far_off"]) == (1.0, 0.0)
    error = np.array([float(row["error_mm"]) for row in rows])
    assert figures["rms_point_mm"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-4)
    ahead = [float(row["target_z_mm"]) for row in rows]
    np.testing.assert_allclose(error, np.array(ahead) - 8.0, atol=30.0)


def test_bad_arguments_give_a_one_line_error_and_exit_2(capsys: pytest.CaptureFixture[str]) -> None:
    for command_line, cause in REFUSED:
        assert main(command_line.split()) == 2, command_line
        captured = capsys.readouterr()
        assert captured.out == ""
        assert len(captured.err.strip().splitlines()) == 1
        assert cause in captured.err


def test_disturbances_are_in_si_and_independent_of_the_claim() -> None:
    noise = "--noise-mm 0.58 --noise-shape normal --outlier-mm 2,3.5"
    others = "--slip -0.05 --bump-mm 2 --untold-delay 3 --sigma-scale 2"
    options = parse([*noise.split(), *others.split()])
    found = options.disturbances
    assert found.noise == pytest.approx(0.00058)
    assert found.noise_shape == "normal"
    assert found.outlier_size == pytest.approx((0.002, 0.0035))
    assert (found.slip, found.bump, found.hidden_delay) == (-0.05, 0.002, 3)
    assert (options.claimed_bound, options.sigma_scale) == (0.001, 2.0)
    assert parse(["--claimed-mm", "0.5"]).claimed_bound == 0.0005
    walking = "--push 2 --rotation-gain 0.8 --roll-walk 5 --layer 0.3,60 --bias-walk 0.3"
    options = parse([*walking.split(), "--step-mm", "2", "--target-drift-mm-per-s", "0.3"])
    found = options.disturbances
    assert (found.push, found.rotation_gain, found.layer) == (2.0, 0.8, (0.3, 0.06))
    # 5 deg of a standard deviation over 1 mm
    assert found.roll_walk * np.sqrt(0.001) == pytest.approx(np.deg2rad(5.0))
    assert (found.noise, found.bias_walk) == pytest.approx((0.00009, 0.0003))
    assert (options.step_length, options.target_drift) == pytest.approx((0.002, 0.0003))
    found = parse(["--student", "3,0.3"]).disturbances
    assert (found.noise_shape, found.degrees_of_freedom) == ("student", 3.0)
    assert found.noise == pytest.approx(0.0003)
    found = parse(["--correlated", "0.9"]).disturbances
    assert (found.noise_shape, found.noise_lasting) == ("normal", 0.9)
    assert found.noise == pytest.approx(0.000577, abs=1e-6)
    options = parse([])
    assert (options.controller, round(options.depth, 9)) == ("best", 0.120)
    assert parse(["--targets", "7"]).depth == pytest.approx(0.150)


@pytest.mark.parametrize("asked", ["--targets 11", "--controller paper --draws 1"])
def test_a_part_of_a_study_gives_the_same_outcomes_as_the_whole(asked: str) -> None:
    """Any division is valid, so that parts can run on many machines."""
    disturbed = (
        "--depth-mm 8 --target-drift-mm-per-s 0.1 --play-deg 10 --push 1 --roll-walk 2 "
        "--bias-walk 1"
    )
    (whole,) = parts_of(parse([*asked.split(), *disturbed.split()]))
    rest = dataclasses.replace(whole, first=4, starts=whole.starts[4:], points=whole.points[4:])
    parts = [whole.of_first(4), rest]
    apart = results_of(parts, [part.run() for part in parts])
    together = results_of([whole], [whole.run()])
    assert apart.columns.keys() == together.columns.keys()
    for name, column in together.columns.items():
        np.testing.assert_array_equal(apart.columns[name], column, err_msg=name)
    assert apart.figures == together.figures
