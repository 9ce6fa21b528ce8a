"""`simulate` in this process: files of a run, and messages."""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from needle_bags.reading.bag_reader import HealthEvent, Run, Status, read_run
from needle_bags.ros import rerun
from needle_bags.run.run_summary import stop_cause, summarize
from needle_bringup.simulated_operator.progress import Progress
from needle_bringup.simulation import simulate
from needle_bringup.simulation.rig_configuration import command_line_parameters, run_info
from needle_bringup.simulation.simulate_options import parse
from needle_bringup.simulation.virtual_run import make_components, run_virtually
from needle_core.component import Actions, Component, Exit, Moment, Timer
from needle_core.errors import UserError
from needle_core.status_messages import ControllerStatus

WORDS = ("--level", "tip", "--depth-mm", "4", "--initial", "0.2,0,0")
KEYS = {
    *("level", "controller", "seed", "steps", "converged", "r1_final_mm", "r1_rms_last_20_mm"),
    *("tip_error_p95_mm", "depth_error_p95_mm", "steps_per_s", "wall_s", "watchdog_trips", "bag"),
}


def record(folder: Path, *argv: str, check: Callable[[], None] = lambda: None) -> bytes:
    """Record a run as `simulate` does; return its MCAP file."""
    options = parse(argv)
    rig = make_components(command_line_parameters(options, folder))
    information = run_info(options)
    run_virtually(
        rig, folder, seed=options.seed, run_info=information, real_time_factor=0.0, check=check
    )
    (file,) = folder.glob("*.mcap")
    return file.read_bytes()


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, Path]:
    """Return the exit code of a whole run, and its folder."""
    folder = tmp_path_factory.mktemp("ended")
    argv = [*WORDS, "--bag", str(folder / "bag"), "--json", str(folder / "result.json")]
    return simulate.main(argv), folder


def test_a_run_leaves_bag_report_and_summary(ended: tuple[int, Path]) -> None:
    code, folder = ended
    summary = json.loads((folder / "bag" / "summary.json").read_text("utf-8"))
    assert (folder / "result.json").read_text() == (folder / "bag" / "summary.json").read_text()
    assert set(summary) >= KEYS
    assert (code, summary["converged"], summary["steps"]) == (0, True, 4)
    assert abs(summary["r1_final_mm"]) < 1.0
    for name in ("report.html", "parameters.yaml", "metadata.yaml"):
        assert (folder / "bag" / name).is_file()
    lines = simulate.describe(summary, folder / "bag").splitlines()
    assert lines[0].startswith("CONVERGED: The tip ended ")
    away = simulate.describe({**summary, "converged": False, "point_error_mm": 2.0}, folder)
    assert away.startswith("MISSED THE POINT: The tip ended 2.00 mm from the point")
    assert "tripped 3 times" in simulate.describe({**summary, "watchdog_trips": 3}, folder)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[bytes]]:
    """Return for each kind of run the bags of a seed, of the same seed again, and of another."""
    folder, drive = tmp_path_factory.mktemp("recorded"), ("--level", "drive", "--depth-mm", "1")
    kinds = {"tip": WORDS, "drive": drive, "continuous": (*WORDS, "--insertion", "continuous")}
    runs = {}
    for kind, argv in kinds.items():
        seeds = enumerate(("1", "1", "2"))
        runs[kind] = [record(folder / f"{kind}_{n}", *argv, "--seed", s) for n, s in seeds]
        assert rerun.main([str(folder / f"{kind}_0")]) == 0
    return runs


@pytest.mark.parametrize("kind", ["tip", "drive", "continuous"])
def test_equal_seeds_give_equal_runs(recorded: Mapping[str, list[bytes]], kind: str) -> None:
    one, again, other = recorded[kind]
    assert again == one
    assert other != one


def test_an_invalid_run_leaves_nothing(tmp_path: Path) -> None:
    bag, file = tmp_path / "bag", tmp_path / "p.yaml"
    file.write_text("plane_controller: {ros__parameters: {curvature: -1.0}}")
    with pytest.raises(UserError, match="curvature = -1"):
        simulate.simulate(parse([*WORDS, "--bag", str(bag), "--params", str(file)]))
    assert not bag.exists()
    with pytest.raises(UserError, match="cannot make the folder"):
        simulate.simulate(parse([*WORDS, "--bag", "/proc/no/bag"]))


def test_folders_of_the_same_second_differ(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulate, "_checkout", lambda: tmp_path)
    monkeypatch.setattr("time.strftime", lambda form: f"now{form[17:]}")
    names = [simulate._make_folder(parse([])).name for _ in range(2)]
    assert names == ["now_camera_best", "now_camera_best_2"]


def test_an_interrupted_run_releases_the_needle_and_its_bag_is_whole(tmp_path: Path) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(tmp_path / "bag", "--level", "tip", check=interrupt)
    run = read_run(tmp_path / "bag")
    assert not run.device_status[-1].values["hold_owner"]
    assert run.device_status[-1].values["state"] == "DISABLED"


class Broken(Component):
    name = "broken"

    def __init__(self) -> None:
        self.timers = (Timer(0.1, self._end),)

    def _end(self, at: Moment) -> Actions:
        yield Exit(3, "out of luck")


def test_a_component_that_ends_first_ends_the_run(tmp_path: Path) -> None:
    rig = [*make_components(command_line_parameters(parse(WORDS), tmp_path)), Broken()]
    with pytest.raises(UserError, match="broken ended with exit code 3: out of luck"):
        run_virtually(
            rig, tmp_path / "b", seed=1, run_info={}, real_time_factor=0.0, check=lambda: None
        )


@pytest.fixture
def stopped(make_run: Callable[..., Path]) -> Run:
    """Return a run that was steered to 30 mm and then waited for a tip."""
    run = read_run(make_run(steps=30, done=False))
    last = run.controller_status[-1]
    off = Status(last.log_time + 20, {**last.values, "state": "IDLE", "reason": "device is off"})
    return dataclasses.replace(run, controller_status=[*run.controller_status, off])


def test_an_unfinished_run_names_its_first_cause(stopped: Run) -> None:
    summary = summarize(stopped)
    assert (summary["converged"], summary["reached_depth"]) == (False, False)
    lines = simulate.describe(summary, Path("bags/run")).splitlines()
    assert lines[0].startswith("NOT FINISHED: ")
    assert lines[0].endswith("but stopped at 30 mm: no tip for 2 s.")
    *before, waits, ends = stopped.controller_status
    # A lost and found tip is not a cause; an earlier report of device or simulation is.
    again = dataclasses.replace(before[-1], log_time=waits.log_time + 5)
    run = dataclasses.replace(stopped, controller_status=[*before, waits, again, ends])
    assert stop_cause(run) == "device is off"
    fault = Status(waits.log_time - 3, {"state": "FAULT", "fault": "no reply", "reason": "x"})
    run = dataclasses.replace(stopped, device_status=[*stopped.device_status, fault])
    assert stop_cause(run) == "no reply"
    left = HealthEvent(waits.log_time - 5, "sim_rig: simulation", 2, "the tip left the phantom")
    assert stop_cause(dataclasses.replace(run, health=[left])) == "the tip left the phantom"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_is_a_line_per_quarter_or_a_bar() -> None:
    stream, terminal = io.StringIO(), Terminal()
    for shown in (Progress(stream), Progress(terminal)):
        for insertion in (0.0, 0.001, 0.003, 0.004):
            steering = ControllerStatus(state="STEERING", insertion_m=insertion, depth_m=0.004)
            shown.show(steering)
        shown.show(dataclasses.replace(steering, insertion_m=1.0, depth_m=None))
        waiting = dataclasses.replace(steering, state="WAITING_FOR_TIP", reason="no tip")
        for status in (steering, waiting, waiting, steering, waiting):
            shown.show(status)
        shown.close("done")
    waits = ["waiting: no tip"] * 2
    lines = ["  1.0 of 4.0 mm", "  3.0 of 4.0 mm", "  4.0 of 4.0 mm", *waits, "done"]
    assert stream.getvalue().splitlines() == lines
    assert "3/4 mm" in terminal.getvalue()
    assert terminal.getvalue().endswith("done\n")
