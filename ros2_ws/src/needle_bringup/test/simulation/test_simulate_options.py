import dataclasses
import shlex
from pathlib import Path

import pytest

from needle_bringup.simulation.simulate_options import (
    CONTROLLERS,
    SimulateOptions,
    command_of,
    parse,
)
from needle_controller.presets.steering_settings import PRESETS
from needle_core.errors import UserError


def test_every_preset_of_the_controller_can_be_asked_for() -> None:
    assert sorted(CONTROLLERS) == sorted(PRESETS)


def test_the_defaults_are_the_designed_ones() -> None:
    assert parse([]) == SimulateOptions(level="camera", controller="best", depth_mm=120.0)


@pytest.mark.parametrize("words", [["--initial", "-3,2,15"], ["--initial=-3,2,15"]])
def test_initial_takes_a_value_that_begins_with_a_minus(words: list[str]) -> None:
    options = parse(words)
    start = (options.initial_x_mm, options.initial_pitch_deg, options.initial_roll_deg)
    assert start == (-3.0, 2.0, 15.0)


@pytest.mark.parametrize("words", [["--target", "-8,5,90"], ["--target=-8,5,90"]])
def test_a_target_is_a_point_with_all_the_depth_there_is(words: list[str]) -> None:
    options = parse(words)
    assert options.target_mm == (-8.0, 5.0, 90.0)
    assert options.depth_mm == 150.0
    assert parse([*words, "--depth-mm", "100"]).depth_mm == 100.0
    assert parse([]).target_mm is None


def test_obstacles_go_with_a_target(tmp_path: Path) -> None:
    path = tmp_path / "obstacles.yaml"
    path.write_text("frame: rig\n", encoding="utf-8")
    assert parse(["--target", "0,0,90", "--obstacles", str(path)]).obstacles == path
    with pytest.raises(UserError, match="--obstacles goes with --target only"):
        parse(["--obstacles", str(path)])
    with pytest.raises(UserError, match="--obstacles no such: no such file"):
        parse(["--target", "0,0,90", "--obstacles", "no such"])


def test_noise_belongs_to_level_tip() -> None:
    assert parse(["--level", "tip"]).noise_mm == 1.0
    assert parse(["--level", "tip", "--noise-mm", "0"]).noise_mm == 0.0
    assert parse([]).noise_mm is None
    with pytest.raises(UserError, match="--noise-mm"):
        parse(["--level", "camera", "--noise-mm", "0"])


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--controller", "worst"], "worst"),
        (["--level", "x"], "'x'"),
        (["--initial", "-3,2"], "X_MM,PITCH_DEG,ROLL_DEG"),
        (["--target", "3,2"], "X_MM,Y_MM,Z_MM"),
        (["--target", "3,2,-5"], "--target Z_MM = -5"),
        (["--initial", "-3,nan,2"], "PITCH_DEG"),
        (["--initial", "-.5,-inf,2"], "PITCH_DEG"),
        (["--initial", "--seed"], "--initial"),
        (["--depth-mm", "nan"], "--depth-mm"),
        (["--depth-mm", "1e9"], "--depth-mm"),
        (["--depth-mm", "deep"], "'deep'"),
        (["--play-deg", "-1"], "--play-deg"),
        (["--lag-mm", "inf"], "--lag-mm"),
        (["--real-time-factor", "-1"], "--real-time-factor"),
        (["--seed", "1.5"], "--seed"),
        (["--seed", "-1"], "--seed"),
        (["--params", "/no/such/file"], "/no/such/file: no such file"),
        (["--params", "/"], "/: a folder, not a file"),
        (["--json", "/no/such/folder/x.json"], "/no/such/folder"),
        (["--depth", "5"], "--depth"),
        (["more"], "more"),
    ],
)
def test_what_cannot_be_run_is_named_in_one_line(words: list[str], named: str) -> None:
    with pytest.raises(UserError) as caught:
        parse(words)
    assert named in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_an_existing_bag_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="exists already"):
        parse(["--bag", str(tmp_path)])
    assert parse(["--bag", str(tmp_path / "new")]).bag == tmp_path / "new"


@pytest.mark.parametrize(
    "line",
    [
        "",
        "--level tip --seed 7",
        "--level tip --noise-mm 0 --controller open_loop",
        "--initial=-1.5,-4,30 --depth-mm 80.25 --play-deg 3 --lag-mm 2 --insertion continuous",
        "--target=-8,5,90 --curvature 4 --diameter-mm 1 --pre-bend-deg 6",
        "--target=0,0,90 --depth-mm 120 --planner mine --estimator its --law theirs",
        "--level drive --real-time-factor 1 --params 'a file.yaml' --bag new --json out.json",
        "--target=0,0,90 --obstacles 'a file.yaml'",
    ],
)
def test_the_command_that_is_recorded_runs_the_same_again(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a file.yaml").touch()
    options = parse(shlex.split(line))
    program, *words = shlex.split(command_of(options))
    assert program == "scripts/simulate"
    assert parse(words) == dataclasses.replace(options, bag=None, json=None)
