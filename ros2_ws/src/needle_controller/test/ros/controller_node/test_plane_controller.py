"""The node in process: steps, bad input and what it says about them."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from needle_controller.model.kinematics import rotation_from_angles
from needle_controller.plane_controller import tip_covariance
from needle_controller.protocol.joint_history import CONFIRMED_BY
from needle_controller.ros.plane_controller import main
from needle_core.convert import from_ros
from needle_core.diagnostics import Level
from needle_core.errors import UserError
from needle_core.messages import PoseWithCovariance
from needle_core.ros.conversions import (
    RELIABLE,
    to_nanoseconds,
    to_stamp,
)

from .node_bench import TICK, Bench


def test_steers_step_by_step(bench: Bench) -> None:
    assert bench.status["state"] == "IDLE"
    bench.start()
    assert bench.status["state"] == "STEERING"
    for number in (1, 2, 3):
        command = bench.step()
        assert list(command.joint_names) == ["insertion_joint", "rotation_joint"]
        (point,) = command.points
        assert point.positions[0] == pytest.approx(number * 0.001)
        assert (point.time_from_start.sec, point.time_from_start.nanosec) == (0, 500_000_000)
        bench.run(command)
        assert bench.status["step"] == str(number)
        assert int(bench.status["tip_after_ns"]) == bench.now
    topics = (
        "needle/estimate",
        "needle/reduced_state",
        "needle/linearized_state",
        "needle/control_input",
    )
    bench.until(lambda: all(len(bench.received[topic]) == 3 for topic in topics))
    for topic in topics:
        assert bench.received[topic][-1].header.stamp == bench.commands[-1].header.stamp
        assert bench.received[topic][-1].header.frame_id == "target_plane"
    reduced = bench.received["needle/reduced_state"][-1].vector
    pose = bench.received["needle/estimate"][-1].pose
    assert pose.pose.position.x == reduced.x == pytest.approx(-0.003, abs=2e-4)
    q = pose.pose.orientation
    heading_x = 2.0 * (q.x * q.z + q.w * q.y)
    assert heading_x == pytest.approx(np.sin(reduced.y), abs=1e-12)
    covariance = np.reshape(pose.covariance, (6, 6))
    assert np.all(np.linalg.eigvalsh(covariance) > 0.0)
    u = bench.received["needle/control_input"][0].vector.y
    assert bench.commands[0].points[0].positions[1] == pytest.approx(u * 0.001)
    assert bench.status["target_offset_m"] == "0.003"
    response = bench.call("stop")
    assert response.success
    bench.until(lambda: bench.status["state"] == "IDLE")


def expose(bench: Bench, position: list[float]) -> bool:
    """Publish a tip; carry out the command that it leads to, and tell whether there was one."""
    before, refused = len(bench.commands), bench.status["tips_rejected"]
    bench.tip(position)
    bench.until(lambda: len(bench.commands) > before or bench.status["tips_rejected"] != refused)
    if len(bench.commands) == before:
        return False
    bench.run(bench.commands[-1])
    return True


def stop_and_start(bench: Bench) -> None:
    assert bench.call("stop").success
    bench.until(lambda: bench.status["state"] == "IDLE")
    bench.start()


@pytest.mark.parametrize("restarted", [False, True])
@pytest.mark.parametrize("wrong", ["two bad tips", "frozen camera"])
def test_after_bad_tips_five_good_ones_are_enough(
    bench: Bench, wrong: str, restarted: bool
) -> None:
    bench.start()
    for _ in range(8):
        bench.run(bench.step())
    frozen = [0.0, 0.0, bench.insertion]
    if wrong == "frozen camera":
        for _ in range(7):
            expose(bench, frozen)
    else:
        for x in (0.0045, 0.009):
            expose(bench, [x, 0.0, bench.insertion])
    if restarted:
        stop_and_start(bench)
    assert any(expose(bench, [0.0, 0.0, bench.insertion]) for _ in range(5))
    assert bench.status["state"] == "STEERING"
    bench.run(bench.step())


def test_joints_that_jump_say_what_to_do_and_go_on_once_they_are_back(bench: Bench) -> None:
    bench.start()
    for _ in range(8):
        bench.run(bench.step())
    deep, steering = bench.insertion, bench.steering
    for place in (0.004, deep):
        bench.insertion = place
        for _ in range(CONFIRMED_BY):
            bench.now += TICK
            bench.joints()
        bench.until(
            lambda: (
                (at := steering.intake.joints.latest) is not None
                and at.insertion == bench.insertion
            )
        )
        bench.until(lambda: bench.status["state"] == "IDLE")
        assert "jumped from 0.008 m" in bench.status["reason"]
        if place < deep:
            assert "draw the needle out" in bench.call("start").message
    bench.start()
    assert any(expose(bench, [0.0, 0.0, bench.insertion]) for _ in range(5))


@pytest.mark.parametrize(
    ("position", "frame", "said"),
    [
        ([float("nan"), 0.0, 0.001], "rig", "not finite"),
        ([0.0, 0.0, 0.001], "left_camera_optical", "left_camera_optical"),
        ([0.12, 0.2, 1.0], "rig", "from the entry point"),
    ],
)
def test_a_bad_tip_is_named_and_moves_nothing(
    bench: Bench, position: list[float], frame: str, said: str
) -> None:
    bench.start()
    bench.run(bench.step())
    sent = len(bench.commands)
    stamp = bench.tip(position, frame)
    bench.until(lambda: bench.status["tips_rejected"] == "1")
    assert said in bench.status["reason"]
    assert bench.status["awaiting"] == "tip"
    assert int(bench.status["tip_after_ns"]) == stamp
    bench.until(lambda: bench.health("steering")[0] == Level.WARN)
    assert said in bench.health("steering")[1]
    assert len(bench.commands) == sent
    bench.step()
    assert len(bench.commands) == sent + 1
    bench.until(lambda: bench.health("steering")[0] == Level.OK)


def test_a_tip_waits_for_the_covariance_with_its_stamp(context: Context) -> None:
    bench = Bench(context, target_offset=0.003, tip_covariance="from_tip_pose")
    poses = bench.outside.create_publisher(PoseWithCovarianceStamped, "needle/tip_pose", RELIABLE)
    bench.until(lambda: poses.get_subscription_count() > 0)
    bench.start()
    stamps = [bench.tip([0.0, 0.0, 0.0])]
    intake = bench.steering.intake
    bench.until(lambda: bool(intake._waiting) and intake.joints.at(stamps[0]) is not None)
    assert not bench.commands
    # That of another tip says that this one's will not come.
    pose = PoseWithCovarianceStamped()
    pose.header.frame_id = "rig"
    pose.pose.covariance[0] = pose.pose.covariance[7] = pose.pose.covariance[14] = 1e-8
    pose.header.stamp = to_stamp(stamps[0] + 1)
    poses.publish(pose)
    bench.until(lambda: bench.status["tips_rejected_for"] == "no_covariance 1")
    assert "needle/tip_pose" in bench.status["reason"]
    stamps.append(bench.tip([0.0, 0.0, 0.0]))
    pose.header.stamp = to_stamp(stamps[1])
    poses.publish(pose)
    bench.until(lambda: len(bench.commands) == 1)
    assert to_nanoseconds(bench.commands[0].header.stamp) == stamps[1]
    bench.close()


def test_a_tip_pose_says_the_positions_covariance() -> None:
    message = PoseWithCovarianceStamped()
    message.pose.covariance = np.arange(36.0)
    known = tip_covariance(from_ros(PoseWithCovariance, message))
    np.testing.assert_array_equal(known.matrix, [[0, 1, 2], [6, 7, 8], [12, 13, 14]])


def test_every_reason_to_refuse_a_tip_is_logged(
    bench: Bench, capfd: pytest.CaptureFixture[str]
) -> None:
    """Within one period of the log: a kind of its own for each reason, repetitions kept back."""
    bench.start()
    for position, frame in (
        ([float("nan")] * 3, "rig"), ([0.0] * 3, "map"), ([1.0] * 3, "rig"), ([1.0] * 3, "rig")
    ):  # fmt: skip
        bench.tip(position, frame)
    bench.until(lambda: bench.status["tips_rejected"] == "4")
    assert bench.status["tips_rejected_for"] == "not_finite 1, frame 1, too_far 2"
    said = capfd.readouterr().err
    for reason in ("not finite", "frame 'map'", "from the entry point"):
        assert said.count(reason) == 1


def test_start_says_why_not(bench: Bench) -> None:
    response = bench.call("start")
    assert (response.success, response.message) == (False, "no device/status has come")


def test_a_start_waits_for_a_device_that_listens(bench: Bench) -> None:
    bench.device()
    listening = next(
        subscription
        for subscription in bench.outside.subscriptions
        if subscription.topic_name == "/device/joint_trajectory"
    )
    bench.outside.destroy_subscription(listening)
    said = "waiting for subscriber of device/joint_trajectory"
    bench.until(lambda: bench.call("start").message == said)
    assert bench.status["state"] == "IDLE"


def test_joints_that_cannot_be_used_are_named(bench: Bench) -> None:
    bench._joints.publish(JointState(name=["insertion_joint"], position=[0.0]))
    bench.until(lambda: bench.health("joint_states")[0] == Level.WARN)
    assert "rotation_joint" in bench.health("joint_states")[1]
    assert bench.steering.intake.joints.latest is None


def test_parameters_change_as_valid_wholes_only(bench: Bench) -> None:
    def set_all(**values: Any) -> list[Any]:
        return list(bench.node.set_parameters([Parameter(n, value=v) for n, v in values.items()]))

    node = bench.node
    before = node.component.settings
    for bad in (
        {"curvature": 0.0},
        {"curvature": float("nan")},
        {"state_weights": [1.0, -1.0, 1.0]},
        {"state_weights": [1.0, 1.0]},
        {"process_noise": [0.0, 0.0, 0.0]},
        {"preset": "best_of_all"},
        {"step_length": 0.01},
    ):
        (result,) = set_all(**bad)
        assert not result.successful, bad
        assert result.reason
        assert node.component.settings == before
    results = set_all(curvature=7.0, preset="open_loop")
    assert all(result.successful for result in results)
    bench.until(lambda: bench.status["preset"] == "open_loop")
    bench.start()
    assert bench.step().points[0].positions[1] == 0.0


def test_covariance_follows_the_messages_convention(bench: Bench) -> None:
    """Fixed axes of target_plane: a sample of small turns has the published covariance."""
    bench.start()
    bench.step()
    bench.until(lambda: bool(bench.received["needle/estimate"]))
    estimate = bench.steering.control._estimator.estimate()
    published = np.reshape(bench.received["needle/estimate"][-1].pose.covariance, (6, 6))
    scale = 1e-4
    rng = np.random.default_rng(1)
    draws = rng.multivariate_normal(np.zeros(6), estimate.covariance, 20_000) * scale
    mean = rotation_from_angles(estimate.coordinates[3:])
    turned = rotation_from_angles(estimate.coordinates[3:] + draws[:, 3:]) @ mean.T
    vectors = np.stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]], axis=-1)
    sampled = np.cov(vectors.T / scale)
    np.testing.assert_allclose(sampled, published[3:, 3:], atol=0.05 * np.max(published[3:, 3:]))


def test_an_unknown_parameter_is_refused(context: Context) -> None:
    with pytest.raises(UserError, match="did you mean 'curvature'"):
        Bench(context, curvatur=8.0)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--ros-args", "-p", "curvatur:=8.0"], "did you mean 'curvature'"),
        (["--ros-args", "-p", "curvature:=-8.0"], "curvature = -8.0 is outside"),
        (["--ros-args", "-p", "state_weights:=[1.0, -1.0, 1.0]"], "state_weights"),
        (["--fast"], "unknown argument '--fast'"),
    ],
)
def test_bad_arguments_are_one_line_and_exit_code_2(
    arguments: list[str],
    said: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "argv", ["plane_controller", *arguments])
    assert main() == 2
    error = capsys.readouterr().err
    assert said in error
    assert len(error.strip().splitlines()) == 1
