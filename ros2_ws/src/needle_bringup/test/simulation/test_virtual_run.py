"""The rig in this process: it repeats byte for byte, and bears what a graph does."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import pytest

from needle_analysis.ros import rerun
from needle_bags.recording.bag_tap import BagTap
from needle_bringup.simulation.rig_configuration import command_line_parameters, run_info
from needle_bringup.simulation.simulate_options import parse
from needle_bringup.simulation.virtual_run import COMPUTE, make_components, run_virtually
from needle_core.component import Output
from needle_core.runners.faults import Fault, delay, drop, duplicate
from needle_core.runners.virtual import DIAGNOSTICS, LOG, VirtualRunner
from needle_sim.sim_rig import SimRig

SHORT = ("--level", "tip", "--depth-mm", "10")
CAMERA = ("--level", "camera", "--depth-mm", "3")
DRIVE = ("--level", "drive", "--depth-mm", "3")
CONTINUOUS = ("--level", "tip", "--depth-mm", "10", "--insertion", "continuous")
COMMANDS, HOLD, RESULTS = "device/joint_trajectory", "device/hold", "device/result"


def mcap_of(folder: Path, *arguments: str) -> bytes:
    """Record a run as `simulate` does; return its MCAP file."""
    options = parse(arguments)
    run_virtually(
        make_components(command_line_parameters(options, folder)),
        folder,
        seed=options.seed,
        run_info=run_info(options),
        real_time_factor=0.0,
        check=lambda: None,
    )
    (file,) = folder.glob("*.mcap")
    return file.read_bytes()


@pytest.mark.parametrize(
    "arguments",
    [SHORT, CONTINUOUS, CAMERA, DRIVE],
    ids=["stepwise", "continuous", "camera", "drive"],
)
def test_one_seed_is_one_run_and_another_another(
    tmp_path: Path, arguments: tuple[str, ...]
) -> None:
    one = mcap_of(tmp_path / "one", *arguments)
    assert mcap_of(tmp_path / "again", *arguments) == one
    assert mcap_of(tmp_path / "other", *arguments, "--seed", "2") != one
    assert rerun.main([str(tmp_path / "one")]) == 0


def test_a_continuous_run_goes_on() -> None:
    rig = Rig(*CONTINUOUS)
    while not rig.runner.run(1.0):
        assert rig.runner.now < 30.0
    assert rig.runner.exits["simulated_operator"].code == 0
    assert rig.outcomes() == {"replaced", "succeeded"}
    depths = [state.positions[0] for state in rig.sent["joint_states"]]
    begin, end = depths.index(next(d for d in depths if d > 0.001)), depths.index(max(depths))
    pace = [later - before for before, later in itertools.pairwise(depths[begin:end])]
    # 2 mm/s, 50 states a second, without a pause on the way
    assert min(pace[:-5]) > 0.5 * 0.002 / 50
    assert rig.depth == pytest.approx(0.01, abs=1e-5)


class Rig:
    """The rig of a command line on a virtual runner, and what its components send."""

    def __init__(self, *arguments: str, seed: int = 1, faults: tuple[Fault, ...] = ()) -> None:
        self.sent: dict[str, list[Any]] = {}
        options = parse(arguments)
        parameters = command_line_parameters(options, Path("none"))
        components = make_components(parameters)
        (self.sim_rig,) = [c for c in components if isinstance(c, SimRig)]
        self.runner = VirtualRunner(
            components, seed, compute=COMPUTE, faults=faults, taps=(self._tap,)
        )

    def _tap(self, stamp_ns: int, sender: str, message: Any, output: Output) -> None:
        self.sent.setdefault(output.topic, []).append(message)

    def until_depth(self, depth: float) -> None:
        while self.depth < depth:
            assert not self.runner.run(0.02), self.runner.exits

    @property
    def depth(self) -> float:
        states = self.sent.get("joint_states")
        return float(states[-1].positions[0]) if states else 0.0

    def outcomes(self) -> set[str]:
        return {result.outcome for result in self.sent[RESULTS]}


@pytest.mark.parametrize("arguments", [SHORT, CONTINUOUS], ids=["stepwise", "continuous"])
@pytest.mark.parametrize("frozen", ["simulated_operator", "plane_controller", "sim_rig"])
def test_a_component_that_stands_still_ends_nothing(
    frozen: str, arguments: tuple[str, ...]
) -> None:
    rig = Rig(*arguments)
    for depth in (0.002, 0.004, 0.006):
        rig.until_depth(depth)
        rig.runner.freeze(frozen, 0.5)
    while not rig.runner.run(1.0):
        assert rig.runner.now < 60.0
    assert rig.runner.exits["simulated_operator"].code == 0
    assert rig.depth == pytest.approx(0.01, abs=1e-5)


def test_no_motion_outlasts_a_hold_that_falls_silent() -> None:
    rig = Rig(*SHORT)
    rig.until_depth(0.0025)
    rig.runner.freeze("simulated_operator", 2.0)
    before = rig.depth
    rig.runner.run(0.15)
    stopped = rig.depth
    rig.runner.run(1.0)
    # 2 mm/s for at most 0.15 s
    assert before < stopped <= before + 0.0003
    assert rig.depth == stopped
    assert any("no hold message" in outcome for outcome in rig.outcomes())


@pytest.mark.parametrize(
    "fault",
    [
        drop("needle/tip", 0.4),
        drop(HOLD, 0.3),
        delay("needle/tip", 0.2),
        duplicate(COMMANDS, 0.05),
        duplicate("needle/tip", 0.3),
    ],
    ids=["tips lost", "holds lost", "tips late", "commands twice", "tips twice"],
)
def test_it_gets_there_in_spite_of_messages_lost_late_and_twice(fault: Fault) -> None:
    rig = Rig(*SHORT, faults=(fault,))
    while not rig.runner.run(1.0):
        assert rig.runner.now < 90.0
    assert rig.runner.exits["simulated_operator"].code == 0, rig.runner.exits
    assert rig.depth == pytest.approx(0.01, abs=1e-5)


def test_pairs_are_exposed_only_when_a_tip_is_awaited() -> None:
    rig = Rig(*CAMERA)
    while not rig.runner.run(1.0):
        assert rig.runner.now < 30.0
    assert rig.depth == pytest.approx(0.003, abs=1e-5)
    assert len(rig.sent["stereo/left/image_raw"]) == len(rig.sent["needle/tip_pose"]) == 4


def test_a_tip_that_leaves_the_phantom_ends_the_run() -> None:
    rig = Rig("--level", "tip", "--controller", "open_loop")
    rig.sim_rig._sensor.half_sizes = (1e-3, math.inf)
    while not rig.runner.run(1.0):
        assert rig.runner.now < 60.0
    ended = rig.runner.exits["simulated_operator"]
    assert ended.code == 1
    assert "the tip left the phantom: x = 1." in ended.text
    x = rig.sent["sim/tip_pose"][-1].position[0]
    assert 0.8e-3 < x < 1.1e-3
    assert rig.sent["device/status"][-1].values["state"] == "FAULT"


def test_a_silent_controller_moves_nothing() -> None:
    rig = Rig(*SHORT, faults=(drop(COMMANDS, 1.0),))
    rig.runner.run(20.0)
    assert rig.depth == 0.0


def test_at_level_drive_the_needle_goes_where_the_motors_go() -> None:
    rig = Rig(*DRIVE)
    while not rig.runner.run(1.0):
        assert rig.runner.now < 30.0
    assert rig.runner.exits["simulated_operator"].code == 0
    assert rig.outcomes() == {"succeeded"}
    assert rig.sent["device/status"][-1].values["simulated"] == "true"
    motors = [at.positions[0] for at in rig.sent["sim/drive_positions"]]
    assert max(motors) == pytest.approx(0.003, abs=1e-5)
    assert rig.sim_rig._bench.insertion == motors[-1]
    assert len(rig.sent["stereo/left/image_raw"]) <= 6


@pytest.mark.parametrize("insertion", ["stepwise", "continuous"])
def test_at_level_drive_a_driver_that_stands_still_stops_the_needle(insertion: str) -> None:
    rig = Rig(*DRIVE, "--insertion", insertion)
    rig.until_depth(0.0015)
    rig.runner.freeze("device_driver", 1.0)
    rig.runner.run(0.1)
    stopped = rig.sim_rig._bench.insertion
    # 2 mm/s until the set-points end
    assert stopped < 0.0015 + 0.0002
    rig.runner.run(0.8)
    assert rig.sim_rig._bench.insertion == stopped
    while not rig.runner.run(1.0):
        assert rig.runner.now < 30.0
    assert "heartbeat was missed" in rig.runner.exits["simulated_operator"].text


def test_pairs_that_the_tracker_did_not_hear_are_left_out_when_it_runs_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = parse(CAMERA)
    components = make_components(command_line_parameters(options, tmp_path / "bag"))
    tap = BagTap(tmp_path / "bag", components, (DIAGNOSTICS, LOG), run_info(options))
    lossy = drop("stereo/left/image_raw", 0.4)
    runner = VirtualRunner(components, 1, compute=COMPUTE, faults=(lossy,), taps=(tap,))
    while not runner.run(1.0):
        assert runner.now < 60.0
    tap.close()
    assert rerun.main([str(tmp_path / "bag")]) == 0
    assert "pairs are left out: stereo_tracker did not hear them" in capsys.readouterr().out
