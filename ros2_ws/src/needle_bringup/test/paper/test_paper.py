from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from needle_bringup.paper.paper import main
from needle_bringup.paper.paper_figures import common_r1, converged_share
from needle_bringup.paper.paper_results import Floats, SteeringTrial, missed_later, settled_mm
from needle_bringup.paper.paper_runs import Laboratory
from needle_core.errors import UserError


def trial(insertion_mm: Floats, r1_mm: Floats) -> SteeringTrial:
    states = np.column_stack([r1_mm, np.zeros((len(r1_mm), 2))])
    return SteeringTrial(insertion_mm, r1_mm, states, states, np.zeros(len(r1_mm)))


def test_settled_is_the_last_entry_into_the_band() -> None:
    insertion = np.arange(6.0)
    assert settled_mm(insertion, np.array([3.0, 2.0, 0.5, 1.5, 1.0, 0.0])) == 4.0
    assert settled_mm(insertion, np.zeros(6)) == 0.0
    assert settled_mm(insertion, np.full(6, 2.0)) == np.inf


def test_runs_that_missed_are_looked_at_again_farther_in() -> None:
    runs = {"r1_final_mm": np.array([0.5, -1.5, 3.0, 1.2])}
    longer = {"r1_final_mm": np.array([5.0, 0.2, -2.0, 0.9])}
    # the first had not missed: what it does later does not count
    assert missed_later(runs, longer) == (3, 1, 2.0)
    assert missed_later({"r1_final_mm": np.zeros(2)}, {"r1_final_mm": np.zeros(2)}) == (0, 0, 0.0)


def test_trials_are_averaged_where_all_of_them_are() -> None:
    one = trial(np.arange(11.0), np.arange(11.0))
    other = trial(np.arange(0.0, 9.0, 2.0), np.zeros(5))
    insertion, r1 = common_r1([one, other])
    np.testing.assert_allclose(insertion, np.arange(9.0))
    np.testing.assert_allclose(r1.mean(axis=0), np.arange(9.0) / 2.0)


def test_the_domain_s_cells_hold_their_own_share() -> None:
    runs = {
        "x_mm": np.array([-15.0, -15.0, 15.0]),
        "roll_deg": np.array([-45.0, -45.0, 45.0]),
        "r1_final_mm": np.array([0.0, 2.0, -1.0]),
    }
    shares = converged_share(runs, "roll_deg", 90.0, cells=2)
    np.testing.assert_allclose(shares, [[0.5, np.nan], [np.nan, 1.0]])


def test_a_study_that_is_there_is_not_run_again(tmp_path: Path) -> None:
    (tmp_path / "one.json").write_text(json.dumps({"runs": 2}), "utf-8")
    (tmp_path / "one.csv").write_text("x_mm,settle_mm\n1,2\n3,\n", "utf-8")
    figures, runs = Laboratory(["/nowhere"], tmp_path).study("one", "--frobnicate")
    assert figures == {"runs": 2}
    np.testing.assert_array_equal(runs["x_mm"], [1.0, 3.0])
    np.testing.assert_array_equal(runs["settle_mm"], [2.0, np.nan])


def test_the_numbers_of_a_study_are_read_whatever_else_it_writes(tmp_path: Path) -> None:
    options = ("--controller", "paper", "--depth-mm", "3")
    figures, runs = Laboratory(["/nowhere"], tmp_path).study("few", *options)
    assert len(runs["r1_final_mm"]) == figures["runs"]
    assert np.all(np.isfinite(runs["r1_final_mm"]))
    assert "controller" not in runs


def test_a_trial_that_does_not_run_is_one_line(tmp_path: Path) -> None:
    simulate = [sys.executable, "-c", "import sys; print('no rig', file=sys.stderr); sys.exit(2)"]
    with pytest.raises(UserError, match=r"trial_1: .*code 2: no rig"):
        Laboratory(simulate, tmp_path).trial("trial_1")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--seed", "x"], "'x'"),
        (["--seed", "-1"], "--seed"),
        (["--json", "/nowhere/f.json"], "/nowhere/f.json"),
        (["--frobnicate"], "--frobnicate"),
    ],
)
def test_bad_arguments_are_one_line_and_exit_2(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert len(captured.err.strip().splitlines()) == 1
    assert said in captured.err


def test_an_out_that_is_a_file_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("", "utf-8")
    assert main(["--out", str(tmp_path / "file")]) == 2
    assert "--out" in capsys.readouterr().err
