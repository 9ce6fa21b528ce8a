"""sim_rig at levels tip and camera, beside a scripted operator and controller."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from needle_core.errors import UserError
from needle_core.ros.conversions import LATCHED, RELIABLE, to_nanoseconds
from needle_sim.rig.bench import SimulatedBench
from needle_sim.ros.sim_rig import SimRigNode
from own_context import own_context

from .bench import LIMIT
from .partner import Rig, running


def five_steps(seed: int) -> tuple[list[Any], list[Any], list[Any]]:
    with running(seed=seed, initial_pitch=0.035, initial_roll=0.26) as rig:
        rig.prepare()
        partner = rig.partner
        for number in range(5):
            assert rig.step().frame_id == "succeeded"
            rig.until_tips(number + 2)
        rig.until(lambda: len(partner.truths) == 6, "truth")
        stamp = partner.tips[-1].header.stamp
        rig.until(lambda: partner.joints[-1].header.stamp == stamp, "joints")
        # Until the first exposure the joints at the start of time are repeated for late joiners.
        joints = [a for a, b in itertools.pairwise(partner.joints) if a != b]
        return partner.tips, [*joints, partner.joints[-1]], partner.truths


def test_five_steps_repeat_bit_for_bit_with_one_seed_and_differ_with_another() -> None:
    first, second, other = five_steps(1), five_steps(1), five_steps(2)
    for one, again in zip(first, second, strict=True):
        assert [(a, b) for a, b in zip(one, again, strict=True) if a != b] == []
    assert first[0] != other[0]
    # The disturbance is in the measurement only: commands were the same, so is the truth.
    assert first[2] == other[2]
    tips, joints, truths = first
    assert joints[-1].position == pytest.approx([0.005, 0.5])
    stamps = [to_nanoseconds(joint.header.stamp) for joint in joints]
    # One at the start of time, 25 in each step, one at each of six exposures: none was lost.
    assert [b - a for a, b in itertools.pairwise(stamps)] == [20_000_000] * 131
    for tip, truth in zip(tips, truths, strict=True):
        assert tip.header == truth.header
        assert tip.header.frame_id == "rig"
        assert abs(tip.point.x - truth.pose.position.x) <= 1e-3
    assert truths[-1].pose.position.z == pytest.approx(0.005, abs=1e-5)


def test_a_rig_that_stands_still_within_a_tick_leaves_no_joints_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    usual = five_steps(1)
    steady, move_to = time.monotonic, SimulatedBench.move_to
    moves, slept = itertools.count(), itertools.accumulate(itertools.repeat(1.0))
    late = 0.0

    def move_late(bench: SimulatedBench, insertion: float, rotation: float) -> None:
        nonlocal late
        move_to(bench, insertion, rotation)
        if next(moves) % 10 == 0:
            late = next(slept)

    monkeypatch.setattr(SimulatedBench, "move_to", move_late)
    monkeypatch.setattr(time, "monotonic", lambda: steady() + late)
    assert five_steps(1) == usual
    assert late > 10.0


def test_it_does_not_begin_beside_another_device() -> None:
    with own_context() as context:
        rig = Rig(context)
        rig.partner.create_publisher(DiagnosticStatus, "device/status", LATCHED)
        try:
            with pytest.raises(UserError, match="/partner publishes device/status"):
                rig.until(lambda: False, "its refusal")
        finally:
            rig.close()


def test_services_refuse_while_partners_are_missing_and_say_which() -> None:
    with own_context() as context:
        sim = SimRigNode(context=context, parameter_overrides=[Parameter("level", value="tip")])
        asker = Node("asker", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(sim)
        executor.add_node(asker)
        client = asker.create_client(SetBool, "device/enable")
        deadline = time.monotonic() + LIMIT

        def until(condition: Callable[[], bool]) -> None:
            while not condition():
                assert time.monotonic() < deadline
                executor.spin_once(timeout_sec=sim.turns())

        def enable(on: bool) -> Any:
            future = client.call_async(SetBool.Request(data=on))
            until(future.done)
            return future.result()

        try:
            until(client.service_is_ready)
            answer = enable(True)
            assert not answer.success
            assert answer.message.startswith("waiting for ")
            assert "publisher of /device/hold" in answer.message
            assert "subscriber of /needle/tip" in answer.message
            # Whoever wants less motion is never kept waiting.
            assert enable(False).success
        finally:
            executor.shutdown()
            asker.destroy_node()
            sim.destroy_node()


def test_time_starts_only_with_the_recorder_where_one_is_wanted() -> None:
    with running(wait_for_recorder=True) as rig:
        rig.until(rig.partner.ready, "services")
        rig.partner.say("IDLE", "nothing", 0)

        def refusal() -> str:
            return str(rig.call("confirm_needle_out", True).message)

        rig.until(lambda: "recorder of" in refusal(), "only the recorder is missing")
        assert "recorder of /sim/tip_pose" in refusal()
        assert "recorder of /joint_states" in refusal()
        assert rig.partner.joints == []


def test_releasing_the_hold_aborts_the_step_and_the_next_tip_tells_where() -> None:
    with running() as rig:
        rig.prepare()
        partner = rig.partner
        # The step would never end: lock step stands still at speed 0.
        partner.scale = 0.0
        partner.send_hold()
        rig.until(lambda: partner.status["speed_scale"] == "0", "standing still")
        partner.command(0.001, 0.1, to_nanoseconds(partner.tips[-1].header.stamp))
        rig.until(lambda: partner.status["state"] == "MOVING", "step under way")
        partner.pressed = False
        rig.until(lambda: len(partner.results) == 1, "abort")
        assert partner.results[0].frame_id == "aborted: hold released"
        assert partner.results[0].stamp == partner.tips[0].header.stamp
        rig.until(lambda: len(partner.tips) == 2, "exposure after the abort")
        rig.until(lambda: partner.status["hold_owner"] == "", "no owner")


def test_a_lapsed_hold_pauses_and_is_counted() -> None:
    with running() as rig:
        rig.prepare()
        partner = rig.partner
        partner.silent = True
        rig.until(lambda: partner.status["reason"].endswith("paused"), "lapse")
        partner.command(0.001, 0.1, to_nanoseconds(partner.tips[-1].header.stamp))
        rig.until(lambda: partner.status["state"] == "MOVING", "step accepted")
        joints = len(partner.joints)
        partner.silent = False
        rig.until(lambda: len(partner.results) == 1, "step done")
        assert partner.results[0].frame_id == "succeeded"
        rig.until(lambda: len(partner.joints) >= joints + 25, "joints of the step")


def test_estop_stops_and_takes_reset_and_enable() -> None:
    with running() as rig:
        rig.prepare()
        partner = rig.partner
        partner.estop(True)
        rig.until(lambda: partner.status["state"] == "ESTOPPED", "emergency stop")
        assert not rig.call("reset").success
        partner.estop(False)
        partner.pressed = False

        def reset() -> bool:
            return bool(rig.call("reset").success)

        rig.until(reset, "reset")
        rig.until(lambda: partner.status["state"] == "DISABLED", "disabled")
        assert rig.call("enable", True).success


def test_a_second_publisher_of_commands_is_refused() -> None:
    with running() as rig:
        rig.prepare()
        partner = rig.partner
        other = partner.create_publisher(JointTrajectory, "device/joint_trajectory", RELIABLE)
        rig.until(lambda: other.get_subscription_count() == 1, "second publisher")
        assert "2 nodes publish commands" in rig.step().frame_id
        rig.until(lambda: partner.status["commands_refused"] == "1", "count")


def test_retraction_draws_the_needle_to_the_entry_point() -> None:
    with running() as rig:
        rig.prepare()
        partner = rig.partner
        for number in range(2):
            assert rig.step().frame_id == "succeeded"
            rig.until_tips(number + 2)
        assert rig.call("retract").success
        rig.until(lambda: partner.joints[-1].position[0] == 0.0, "retracted")
        assert partner.joints[-1].position[1] == pytest.approx(0.2)
        rig.until(lambda: partner.status["state"] == "HOLDING", "holding")


def test_real_time_exposes_by_rate_and_a_lapse_aborts() -> None:
    with running(real_time_factor=1.0, camera_rate=10.0) as rig:
        rig.prepare()
        partner = rig.partner
        rig.until(lambda: len(partner.tips) >= 5, "tips")
        stamps = [to_nanoseconds(tip.header.stamp) for tip in partner.tips]
        assert {b - a for a, b in itertools.pairwise(stamps)} == {100_000_000}
        partner.scale = 0.0
        partner.send_hold()
        rig.until(lambda: partner.status["speed_scale"] == "0", "standing still")
        partner.command(0.001, 0.0, to_nanoseconds(partner.tips[-1].header.stamp))
        rig.until(lambda: partner.status["state"] == "MOVING", "step under way")
        partner.silent = True
        rig.until(lambda: len(partner.results) == 1, "abort")
        assert partner.results[0].frame_id.startswith("aborted: no hold message for")
        rig.until(lambda: int(partner.status["watchdog_trips"]) >= 1, "count")


def test_camera_exposes_pairs_again_when_lost_and_ends_where_the_tip_leaves_the_phantom() -> None:
    # Almost straight up: out of the surface, 17.5 mm above, within ten steps.
    with running(level="camera", initial_pitch=1.4, curvature=0.0) as rig:
        rig.prepare()
        partner = rig.partner
        rig.until(lambda: len(partner.pairs) == 1, "first pair")
        left, right = partner.pairs[0]["left"], partner.pairs[0]["right"]
        assert left.header.stamp == right.header.stamp
        assert left.header.frame_id == "left_camera_optical"
        assert right.header.frame_id == "right_camera_optical"
        assert (left.encoding, left.step, len(left.data)) == ("mono8", 1024, 1024 * 768)
        assert bytes(left.data) != bytes(right.data)
        rig.until(lambda: len(partner.infos) == 2, "camera infos")
        assert all(info.header.stamp == left.header.stamp for info in partner.infos)

        partner.found = False
        partner.rotation_per_step = 0.0
        assert rig.step(0.002).frame_id == "succeeded"
        rig.until(lambda: len(partner.pairs) == 4, "exposures again while the tip is lost")
        partner.found = True

        outcome = "succeeded"
        for _ in range(12):
            pairs = len(partner.pairs)
            outcome = rig.step(0.002).frame_id
            if outcome != "succeeded":
                break
            rig.until(lambda n=pairs: len(partner.pairs) > n, "pair after the step")  # type: ignore[misc]
        assert outcome.startswith("aborted: the tip left the phantom: x = 17.5")
        rig.until(lambda: partner.status["state"] == "FAULT", "fault")
        assert partner.status["fault"] in outcome
        assert "the run has ended" in rig.call("reset").message


def test_what_it_renders_is_written_with_insertion_and_truth(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    with running(level="camera", scenario="clutter", seed=3, images=str(folder)) as rig:
        rig.prepare()
        partner = rig.partner
        rig.until(lambda: len(partner.pairs) == 1, "first pair")
        assert rig.step(0.002).frame_id == "succeeded"
        rig.until(lambda: len(partner.pairs) == 2, "pair after the step")
        sent, truth = partner.pairs, partner.truths[1].pose.position
    for number, pair in enumerate(sent):
        for side, image in pair.items():
            written = cv2.imread(str(folder / side / f"{number:06d}.png"), cv2.IMREAD_UNCHANGED)
            assert written is not None
            assert written.tobytes() == bytes(image.data)
    lines = (folder / "insertion.csv").read_text().splitlines()
    assert lines[:2] == ["name,insertion_m", "000000.png,0.0"]
    assert float(lines[2].split(",")[1]) == pytest.approx(0.002)
    lines = (folder / "truth.csv").read_text().splitlines()
    assert lines[1] == "000000.png,,,,,,,,0.0,0.0"
    assert [float(value) for value in lines[2].split(",")[1:4]] == [truth.x, truth.y, truth.z]
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
    with own_context() as context, pytest.raises(UserError, match=message):
        Rig(context, **parameters)
