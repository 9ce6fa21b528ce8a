"""sim_rig as a component at levels tip and camera, beside a person who holds and gives steps."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import cv2
import pytest

from needle_core import messages as m
from needle_core.errors import UserError
from needle_core.settings.parameter_fields import from_values
from needle_core.status_messages import ControllerStatus
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_sim.sim_rig import SimRig
from needle_sim.sim_rig_parameters import SimRigParameters

from .person import SIDES, VirtualBench


class Bench(VirtualBench):
    def __init__(self, **parameters: Any) -> None:
        values = {"level": "tip", **parameters}
        self.rig = SimRig(from_values(SimRigParameters, values, "sim_rig"))
        super().__init__(self.rig, seed=0)

    def prepare(self) -> None:
        self.run(0.5)
        for name, request in (("confirm_needle_out", True), ("home", None), ("enable", True)):
            answer = self.call(name, request)
            assert answer.success, answer.text
        self.until(lambda: self.status.homed)
        self.person.pressed = True
        self.until(lambda: self.status.hold_owner == "person")
        awaiting = ControllerStatus(state="STEERING", awaiting="tip")
        self.publish("needle/controller_status", awaiting)
        self.until(lambda: self.heard("sim/tip_pose"))

    def step(self, length: float = 0.001, rotation: float = 0.1) -> str:
        """Give one step after a new exposure; return how it ended."""
        exposures, results = len(self.heard("sim/tip_pose")), len(self.outcomes)
        self.until(lambda: len(self.heard("sim/tip_pose")) > exposures)
        self.run(0.05)
        self.command(length, rotation, 0.5, self.heard("sim/tip_pose")[-1].stamp_ns)
        self.until(lambda: len(self.outcomes) > results)
        return self.outcomes[-1]

    def be_in_a_step(self) -> None:
        self.prepare()
        self.command(0.001, 0.1, 0.5, self.heard("sim/tip_pose")[-1].stamp_ns)
        self.until(lambda: self.status.state == "MOVING")


def two_steps(seed: int) -> Bench:
    bench = Bench(seed=seed, initial_pitch=0.035, initial_roll=0.26)
    bench.prepare()
    assert [bench.step() for _ in range(2)] == ["succeeded"] * 2
    bench.run(0.05)
    return bench


def test_one_seed_repeats_and_another_differs_in_the_measurement_alone() -> None:
    first, again, other = two_steps(1), two_steps(1), two_steps(2)
    assert first.person.heard == again.person.heard
    assert first.heard("needle/tip") != other.heard("needle/tip")
    assert first.heard("sim/tip_pose") == other.heard("sim/tip_pose")
    truths = {truth.stamp_ns: truth.position for truth in first.heard("sim/tip_pose")}
    for tip in first.heard("needle/tip"):
        assert tip.frame_id == "rig"
        assert math.dist(tip.position, truths[tip.stamp_ns]) <= math.sqrt(3) * 1e-3
    # Uniform within 1 mm of the truth, along each axis.
    assert first.heard("needle/tip_pose")[-1].covariance[:15:7] == pytest.approx((1e-6 / 3.0,) * 3)
    joints = first.heard("joint_states")
    assert joints[-1].positions == pytest.approx((0.002, 0.2))
    periods = [b.stamp_ns - a.stamp_ns for a, b in itertools.pairwise(joints)]
    assert periods == pytest.approx([20_000_000] * len(periods), abs=1_000_000)


@pytest.mark.parametrize("lets_go", [True, False])
def test_a_person_who_lets_go_or_falls_silent_stops_the_step(lets_go: bool) -> None:
    bench = Bench()
    bench.be_in_a_step()
    bench.person.pressed, bench.person.speaks = not lets_go, lets_go
    bench.until(lambda: bench.outcomes)
    why = "aborted: hold released" if lets_go else "aborted: no hold message for"
    assert bench.outcomes[0].startswith(why)
    assert bench.heard("joint_states")[-1].positions[0] < 0.001
    assert (bench.status.watchdog_trips >= 1) is not lets_go
    bench.until(lambda: bench.status.hold_owner == "")


def test_a_needle_that_leaves_the_phantom_ends_the_run() -> None:
    # Almost straight up: out of the surface, 17.5 mm above; drawn at the first exposure only.
    bench = Bench(level="camera", initial_pitch=1.4, curvature=0.0)
    bench.prepare()
    left, right = (bench.heard(f"stereo/{side}/image_raw")[0] for side in SIDES)
    assert left.stamp_ns == right.stamp_ns
    assert (left.frame_id, right.frame_id) == ("left_camera_optical", "right_camera_optical")
    assert (left.encoding, left.step, len(left.data)) == ("mono8", 1024, 1024 * 768)
    assert bytes(left.data) != bytes(right.data)
    bench.publish("needle/controller_status", ControllerStatus())
    while not bench.outcomes or bench.outcomes[-1] == "succeeded":
        ended = len(bench.outcomes)
        bench.command(0.002, 0.0, 0.4)
        bench.until(lambda: len(bench.outcomes) > ended)  # noqa: B023 - called at once
    assert 5 < len(bench.outcomes) < 12
    assert bench.outcomes[-1].startswith("aborted: the tip left the phantom: x = 17.5")
    bench.until(lambda: bench.status.state == "FAULT")
    assert "the tip left the phantom" in bench.call("reset").text


def test_what_it_renders_is_written_with_insertion_and_truth(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    bench = Bench(level="camera", scenario="clutter", seed=3, images=str(folder))
    bench.prepare()
    bench.publish("needle/controller_status", ControllerStatus())
    bench.command(0.002, 0.0, 0.5)
    bench.until(lambda: bench.outcomes == ["succeeded"])
    exposures = len(bench.heard("sim/tip_pose"))
    bench.until(lambda: len(bench.heard("sim/tip_pose")) > exposures)
    bench.run(0.05)
    bench.rig.close()
    for side in SIDES:
        for number, image in enumerate(bench.heard(f"stereo/{side}/image_raw")):
            written = cv2.imread(str(folder / side / f"{number:06d}.png"), cv2.IMREAD_UNCHANGED)
            assert written is not None
            assert written.tobytes() == bytes(image.data)
    lines = (folder / "insertion.csv").read_text().splitlines()
    assert lines[:2] == ["name,insertion_m", "000000.png,0.0"]
    assert float(lines[-1].split(",")[1]) == pytest.approx(0.002)
    last = (folder / "truth.csv").read_text().splitlines()[-1].split(",")
    assert tuple(map(float, last[1:4])) == bench.heard("sim/tip_pose")[-1].position
    assert (folder / "calibration.yaml").is_file()


def test_at_level_drive_the_motors_move_the_needle_and_its_way_out_presses_the_stop() -> None:
    bench = Bench(level="drive", initial_pitch=1.4, curvature=0.0)
    bench.run(0.5)
    for insertion, wait in ((0.001, 1.1), (0.02, 0.1)):
        names = (m.INSERTION_JOINT, m.ROTATION_JOINT)
        bench.publish("sim/drive_positions", m.JointState(0, names, (insertion, 0.0), (0.0, 0.0)))
        bench.run(wait)
    x, _, z = bench.heard("sim/tip_pose")[-1].position
    assert math.hypot(x, z) == pytest.approx(0.001)
    assert [stop.pressed for stop in bench.heard("device/estop")] == [True]


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"scenario": "fog"}, "scenario = 'fog' is not one of clean"),
        ({"scenario": "clutter"}, "scenario = 'clutter': level tip has no images"),
        ({"images": "somewhere"}, "images = 'somewhere': level tip has no images"),
        ({"level": "camera", "images": "/dev/null/x"}, "cannot write /dev/null/x"),
        ({"level": "x"}, "level"),
        ({"curvature": -1.0}, "curvature"),
        ({"speed": 1.0}, "unknown parameter 'speed'"),
        ({"level": "camera", "calibration_file": "/nowhere.yaml"}, "/nowhere.yaml"),
        # Hard caps cannot be configured away.
        ({"max_speed": 0.006}, "max_speed"),
        ({"max_step_length": 1.0}, "max_step_length"),
        ({"hold_timeout": 1.0}, "hold_timeout"),
    ],
)
def test_bad_parameters_are_refused_in_one_line(parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        Bench(**parameters)


def test_the_limits_that_are_given_are_kept() -> None:
    given = {
        name: 0.9 * value
        for name, value in vars(SafetyLimits()).items()
        if name in vars(SimRigParameters())
    }
    assert len(given) > 5
    limits = SimRigParameters(**given).limits
    assert {name: getattr(limits, name) for name in given} == given
