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

# Invalid combinations and forms, and the part that the error names; `number` checks the bounds.
REFUSED = (
    ("--grid hexagonal", "hexagonal"),
    ("--noise-shape round", "--noise-shape 'round'"),
    ("--student 3", "--student '3' is not DOF,SCALE_MM"),
    ("--bias-walk 1 --student 3,1", "--student and --bias-walk are alternative"),
    ("--correlated 0.5 --noise-shape normal", "--correlated and --noise-shape normal are"),
    ("--bias-walk 1 --noise-mm 2", "--noise-mm cannot be combined"),
    ("--outlier-mm 5,2", "--outlier-mm HI = 2"),
    ("--layer 0.01,60", "--layer S = 0.01"),
    ("--initial 1,2", "--initial"),
    ("--controller nobody", "nobody"),
    ("--controller paper --flips 3", "flip"),
    ("--targets 5 --controller paper", "paper cannot steer to a point"),
    ("--targets 5 --turn-delay-mm 0.5", "--turn-delay-mm is for needles"),
    ("--targets 3 --controller rrt --law a", "rrt is a law"),
    ("--planner a", "--planner applies to --targets only"),
    ("--estimator a", "= 'a': no installed package provides it"),
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
    assert (figures["runs"], figures["converged_at_end"]) == (4, None)
    # 8 mm are too short for all of them
    assert (figures["within_1_mm_point"], figures["missed_runs"]) == (0.0, 4)
    # The controller knows its position, and reports that it missed the point.
    assert (figures["doubtful_at_end"], figures["trusted_far_off"]) == (1.0, 0.0)
    error = np.array([float(row["error_mm"]) for row in rows])
    assert figures["rms_point_mm"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-4)
    ahead = [float(row["target_z_mm"]) for row in rows]
    np.testing.assert_allclose(error, np.array(ahead) - 8.0, atol=30.0)


def test_contradicting_arguments_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    for command_line, cause in REFUSED:
        assert main(command_line.split()) == 2, command_line
        assert cause in capsys.readouterr().err


def test_disturbances_are_in_si_and_independent_of_the_claim() -> None:
    given = "--noise-mm 0.58 --outlier-mm 2,3.5 --bump-mm 2 --roll-walk 5 --layer 0.3,60"
    options = parse([*given.split(), "--step-mm", "2", "--target-drift-mm-per-s", "0.3"])
    found = options.disturbances
    assert (found.noise, found.bump) == pytest.approx((0.00058, 0.002))
    assert found.outlier_size == pytest.approx((0.002, 0.0035))
    assert found.layer == pytest.approx((0.3, 0.06))
    # 5 deg of a standard deviation over 1 mm
    assert found.roll_walk * np.sqrt(0.001) == pytest.approx(np.deg2rad(5.0))
    assert (options.step_length, options.target_drift) == pytest.approx((0.002, 0.0003))
    assert options.claimed_bound == 0.001
    for noise, shape, size in (
        ("--student 3,0.3", "student", 0.0003),
        ("--correlated 0.9", "normal", 0.001 / np.sqrt(3.0)),
        ("--bias-walk 0.3", "uniform", 0.00009),
    ):
        found = parse(noise.split()).disturbances
        assert found.noise_shape == shape
        assert found.noise == pytest.approx(size)
    for depth, argv in ((0.120, []), (0.150, ["--targets", "7"])):
        assert parse(argv).depth == pytest.approx(depth)


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
