"""sim_rig as a component at levels tip and camera, beside a person who holds and gives steps."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest

from needle_core import messages as m
from needle_core.component import (
    BEST_EFFORT,
    LATCHED,
    Action,
    Actions,
    Answer,
    Call,
    Component,
    Input,
    Moment,
    Output,
    Publish,
    Timer,
)
from needle_core.errors import UserError
from needle_core.runners.virtual import VirtualRunner
from needle_core.settings.parameter_fields import from_values
from needle_core.status_messages import ControllerStatus, DeviceStatus
from needle_sim.sim_rig import SimRig
from needle_sim.sim_rig_parameters import SimRigParameters

SIDES = ("left", "right")
JOINTS = (m.INSERTION_JOINT, m.ROTATION_JOINT)
LIMIT = 20.0


class Person(Component):
    """Plays operator and controller, and keeps what it hears."""

    name = "person"

    def __init__(self) -> None:
        self.heard: dict[str, list[Any]] = {}
        self.answers: dict[str, Answer] = {}
        self.pressed = False
        self.speaks = True
        self.scale = 1.0
        self.actions: list[Action] = []
        kinds = {
            "needle/tip": m.Point,
            "joint_states": m.JointState,
            "sim/tip_pose": m.Pose,
            "device/result": m.CommandResult,
            **{f"stereo/{side}/image_raw": m.Image for side in SIDES},
            **{f"stereo/{side}/camera_info": m.CameraInfo for side in SIDES},
        }
        self.inputs = (
            *(Input(topic, kind, self._keep(topic)) for topic, kind in kinds.items()),
            Input("device/status", DeviceStatus, self._keep("device/status"), LATCHED),
        )
        self.outputs = (
            Output("device/hold", m.HoldState, BEST_EFFORT),
            Output("device/joint_trajectory", m.Trajectory),
            Output("device/estop", m.EmergencyStop),
            Output("needle/controller_status", ControllerStatus, LATCHED),
        )
        self.timers = (Timer(0.05, self._act),)

    def on_answer(self, answer: Answer, at: Moment) -> Actions:
        self.answers[answer.service] = answer
        return ()

    def _keep(self, topic: str) -> Callable[[Any, Moment], Actions]:
        messages = self.heard.setdefault(topic, [])

        def keep(message: Any, at: Moment) -> Actions:
            messages.append(message)
            return ()

        return keep

    def _act(self, at: Moment) -> Actions:
        if self.speaks:
            hold = m.HoldState("person", "", at.stamp_ns, self.pressed, self.scale, 0.1)
            yield Publish("device/hold", hold)
        yield from self.actions
        self.actions = []


class Bench:
    """Both on a virtual runner."""

    def __init__(self, **parameters: Any) -> None:
        values = {"level": "tip", **parameters}
        self.rig = SimRig(from_values(SimRigParameters, values, "sim_rig"))
        self.person = Person()
        self.runner = VirtualRunner([self.rig, self.person])

    def until(self, condition: Callable[[], bool]) -> None:
        end = self.runner.timeline.now + LIMIT
        while not condition():
            assert self.runner.timeline.now < end, self.status
            self.runner.run(0.01)

    @property
    def status(self) -> DeviceStatus:
        said = self.person.heard["device/status"]
        return said[-1] if said else DeviceStatus()

    def heard(self, topic: str) -> list[Any]:
        return self.person.heard[topic]

    def call(self, name: str, request: bool | None = None) -> Answer:
        service = f"device/{name}"
        self.person.answers.pop(service, None)
        self.person.actions.append(Call(service, request))
        self.until(lambda: service in self.person.answers)
        return self.person.answers[service]

    def prepare(self) -> None:
        self.runner.run(0.5)
        for name, request in (("confirm_needle_out", True), ("home", None), ("enable", True)):
            answer = self.call(name, request)
            assert answer.success, answer.text
        self.until(lambda: self.status.homed)
        self.person.pressed = True
        self.until(lambda: self.status.hold_owner == "person")
        self.want_tip()
        self.until(lambda: bool(self.heard("sim/tip_pose")))

    def want_tip(self) -> None:
        status = ControllerStatus(state="STEERING", awaiting="tip")
        self.person.actions.append(Publish("needle/controller_status", status))

    def command(self, length: float = 0.001, rotation: float = 0.1) -> None:
        last = self.heard("joint_states")[-1]
        stamp_ns = self.heard("sim/tip_pose")[-1].stamp_ns
        place = (last.positions[0] + length, last.positions[1] + rotation)
        points = (m.TrajectoryPoint(place, 0.5),)
        trajectory = m.Trajectory(stamp_ns, JOINTS, points)
        self.person.actions.append(Publish("device/joint_trajectory", trajectory))

    def step(self, length: float = 0.001, rotation: float = 0.1) -> str:
        """Give one step after a new exposure; return how it ended."""
        exposures, results = len(self.heard("sim/tip_pose")), len(self.heard("device/result"))
        self.until(lambda: len(self.heard("sim/tip_pose")) > exposures)
        self.runner.run(0.05)
        self.command(length, rotation)
        self.until(lambda: len(self.heard("device/result")) > results)
        return str(self.heard("device/result")[-1].outcome)


def five_steps(seed: int) -> Bench:
    bench = Bench(seed=seed, initial_pitch=0.035, initial_roll=0.26)
    bench.prepare()
    assert [bench.step() for _ in range(5)] == ["succeeded"] * 5
    bench.runner.run(0.05)
    return bench


def test_one_seed_repeats_and_another_differs_in_the_measurement_alone() -> None:
    first, again, other = five_steps(1), five_steps(1), five_steps(2)
    assert first.person.heard == again.person.heard
    assert first.heard("needle/tip") != other.heard("needle/tip")
    assert first.heard("sim/tip_pose") == other.heard("sim/tip_pose")


def test_tips_are_the_truth_but_for_noise_and_joints_come_50_times_a_second() -> None:
    bench = five_steps(1)
    truths = {truth.stamp_ns: truth.position for truth in bench.heard("sim/tip_pose")}
    for tip in bench.heard("needle/tip"):
        assert tip.frame_id == "rig"
        assert math.dist(tip.position, truths[tip.stamp_ns]) <= math.sqrt(3) * 1e-3
    joints = bench.heard("joint_states")
    assert joints[-1].positions == pytest.approx((0.005, 0.5))
    periods = [b.stamp_ns - a.stamp_ns for a, b in itertools.pairwise(joints)]
    assert periods == pytest.approx([20_000_000] * len(periods), abs=1_000_000)


def test_releasing_the_hold_aborts_the_step() -> None:
    bench = Bench()
    bench.prepare()
    bench.person.scale = 0.0
    bench.until(lambda: bench.status.speed_scale == 0.0)
    bench.command()
    bench.until(lambda: bench.status.state == "MOVING")
    bench.person.pressed = False
    bench.until(lambda: bool(bench.heard("device/result")))
    assert bench.heard("device/result")[0].outcome == "aborted: hold released"
    bench.until(lambda: bench.status.hold_owner == "")


def test_a_person_who_falls_silent_stops_the_step() -> None:
    bench = Bench()
    bench.prepare()
    bench.command(0.001)
    bench.until(lambda: bench.status.state == "MOVING")
    bench.person.speaks = False
    bench.until(lambda: bool(bench.heard("device/result")))
    assert bench.heard("device/result")[0].outcome.startswith("aborted: no hold message for")
    assert bench.heard("joint_states")[-1].positions[0] < 0.001
    assert bench.status.watchdog_trips >= 1


def test_an_emergency_stop_takes_reset_and_enable() -> None:
    bench = Bench()
    bench.prepare()
    bench.person.actions.append(Publish("device/estop", m.EmergencyStop(pressed=True)))
    bench.until(lambda: bench.status.state == "ESTOPPED")
    assert not bench.call("reset").success
    bench.person.actions.append(Publish("device/estop", m.EmergencyStop(pressed=False)))
    bench.person.pressed = False
    bench.runner.run(0.1)
    assert bench.call("reset").success
    assert bench.status.state == "DISABLED"
    assert bench.call("enable", True).success


def test_retraction_draws_the_needle_to_the_entry_point() -> None:
    bench = Bench()
    bench.prepare()
    assert [bench.step() for _ in range(2)] == ["succeeded"] * 2
    assert bench.call("retract").success
    bench.until(lambda: bench.heard("joint_states")[-1].positions[0] == 0.0)
    assert bench.heard("joint_states")[-1].positions[1] == pytest.approx(0.2)
    bench.until(lambda: bench.status.state == "HOLDING")


def test_a_needle_that_leaves_the_phantom_ends_the_run() -> None:
    # Almost straight up: out of the surface, 17.5 mm above, within ten steps.
    bench = Bench(level="camera", initial_pitch=1.4, curvature=0.0)
    bench.prepare()
    left, right = (bench.heard(f"stereo/{side}/image_raw")[0] for side in SIDES)
    assert left.stamp_ns == right.stamp_ns
    assert (left.frame_id, right.frame_id) == ("left_camera_optical", "right_camera_optical")
    assert (left.encoding, left.step, len(left.data)) == ("mono8", 1024, 1024 * 768)
    assert bytes(left.data) != bytes(right.data)
    outcomes: list[str] = []
    while not outcomes or outcomes[-1] == "succeeded":
        outcomes.append(bench.step(0.002, 0.0))
    assert 5 < len(outcomes) < 12
    assert outcomes[-1].startswith("aborted: the tip left the phantom: x = 17.5")
    bench.until(lambda: bench.status.state == "FAULT")
    assert "the tip left the phantom" in bench.call("reset").text


def test_what_it_renders_is_written_with_insertion_and_truth(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    bench = Bench(level="camera", scenario="clutter", seed=3, images=str(folder))
    bench.prepare()
    assert bench.step(0.002) == "succeeded"
    exposures = len(bench.heard("sim/tip_pose"))
    bench.until(lambda: len(bench.heard("sim/tip_pose")) > exposures)
    bench.runner.run(0.05)
    bench.rig.close()
    for side in SIDES:
        for number, image in enumerate(bench.heard(f"stereo/{side}/image_raw")):
            written = cv2.imread(str(folder / side / f"{number:06d}.png"), cv2.IMREAD_UNCHANGED)
            assert written is not None
            assert written.tobytes() == bytes(image.data)
    truth = bench.heard("sim/tip_pose")[-1].position
    lines = (folder / "insertion.csv").read_text().splitlines()
    assert lines[:2] == ["name,insertion_m", "000000.png,0.0"]
    assert float(lines[-1].split(",")[1]) == pytest.approx(0.002)
    lines = (folder / "truth.csv").read_text().splitlines()
    assert [float(value) for value in lines[-1].split(",")[1:4]] == list(truth)
    assert (folder / "calibration.yaml").is_file()


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"scenario": "fog"}, "scenario = 'fog' is not one of clean"),
        ({"scenario": "clutter"}, "scenario = 'clutter': level tip has no images"),
        ({"images": "somewhere"}, "images = 'somewhere': level tip has no images"),
        ({"level": "camera", "images": "/dev/null/x"}, "cannot write /dev/null/x"),
        ({"level": "x"}, "level"),
        ({"curvature": -1.0}, "curvature"),
        ({"max_speed": 0.006}, "max_speed"),
        ({"speed": 1.0}, "unknown parameter 'speed'"),
        ({"level": "camera", "calibration_file": "/nowhere.yaml"}, "/nowhere.yaml"),
    ],
)
def test_bad_parameters_are_refused_in_one_line(parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        Bench(**parameters)
