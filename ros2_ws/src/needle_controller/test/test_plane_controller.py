"""plane_controller as a component: inputs, services and timer."""

from __future__ import annotations

import dataclasses
import math
from collections import defaultdict
from typing import Any

import numpy as np
import pytest

from needle_controller.controller_status import received_messages
from needle_controller.model.kinematics import rotation_from_angles
from needle_controller.observers.estimator import pose_estimate
from needle_controller.plane_controller import COMMANDS, STATUS, PlaneController, tip_covariance
from needle_controller.presets.steering_settings import SteeringSettings
from needle_core import messages as m
from needle_core.component import Actions, Diagnose, Log, Moment, Peers, Publish, Reply
from needle_core.diagnostics import Diagnostic, Level
from needle_core.status_messages import ControllerStatus, DeviceStatus

TICK = 20_000_000
STRAIGHT = (0.0, 0.0, 0.0, 1.0)
BALL = m.Marker("rig", "bone", 1, 2, 0, (0.0, 0.0, 0.06), STRAIGHT, (0.004, 0.004, 0.004))
SETTINGS = SteeringSettings(target_offset=0.003, tip_covariance="configured")


class Bench:
    """The component, a scripted device and a scripted tracker."""

    def __init__(self, settings: SteeringSettings = SETTINGS, receiver: str = "/device") -> None:
        self.component = PlaneController(settings)
        self.now, self.later = TICK, 0.0
        self.position = {"rotation": 0.0, "insertion": 0.0}
        self.published: defaultdict[str, list[Any]] = defaultdict(list)
        self.health: dict[str, Diagnostic] = {}
        self.logs: list[str] = []
        self.replies: list[Reply] = []
        self.do(self.component.on_peers(Peers(subscribers={COMMANDS: (receiver,)}), self.at))

    @property
    def at(self) -> Moment:
        return Moment(self.now * 1e-9 + self.later, self.now, self.now)

    @property
    def status(self) -> ControllerStatus:
        return self.published[STATUS][-1]  # type: ignore[no-any-return]

    def do(self, actions: Actions) -> None:
        for action in actions:
            match action:
                case Publish(topic, message):
                    self.published[topic].append(message)
                case Diagnose(part, diagnostic):
                    self.health[part] = diagnostic
                case Log(text=text):
                    self.logs.append(text)
                case Reply():
                    self.replies.append(action)

    def receive(self, topic: str, message: Any) -> None:
        (row,) = (row for row in self.component.inputs if row.topic == topic)
        assert isinstance(message, row.message)
        self.do(row.handler(message, self.at))

    def set_up(self, **changes: Any) -> None:
        """Change parameters."""
        settings = dataclasses.replace(SETTINGS, **changes)
        self.do(self.component.on_settings(settings, self.at))

    def call(self, service: str) -> tuple[bool, str]:
        (row,) = (row for row in self.component.services if row.name.endswith(service))
        self.do(row.handler(None, 7, self.at))
        assert self.replies[-1].request == 7
        return self.replies[-1].success, self.replies[-1].text

    def joints(self, **positions: float) -> None:
        self.now += TICK
        names = tuple(f"{name}_joint" for name in positions)
        self.receive("joint_states", m.JointState(self.now, names, tuple(positions.values())))

    def tip(self, x: float = 0.0, frame: str = "rig") -> None:
        self.joints(**self.position)
        place = (x, 0.0, self.position["insertion"])
        self.receive("needle/tip", m.Point(self.now, frame, place))

    def started(self) -> Bench:
        self.receive(
            "device/status", DeviceStatus(state="HOLDING", homed=True, hold_owner="operator")
        )
        self.joints(**self.position)
        assert self.call("start") == (True, "steering")
        return self

    def step(self, pose: m.PoseWithCovariance | None = None) -> m.Trajectory:
        """Send a tip, execute the resulting command, and answer."""
        self.tip()
        if pose is not None:
            self.receive("needle/tip_pose", dataclasses.replace(pose, stamp_ns=self.now))
        command: m.Trajectory = self.published[COMMANDS][-1]
        assert command.stamp_ns == self.now
        insertion, rotation = command.points[0].positions
        self.position = {"rotation": rotation, "insertion": insertion}
        self.joints(**self.position)
        self.receive("device/result", m.CommandResult(command.stamp_ns, "succeeded"))
        return command


def test_it_steers_in_steps_and_publishes_its_estimate() -> None:
    bench = Bench().started()
    assert bench.status.state == "STEERING"
    for number in (1, 2):
        before, command = bench.position["rotation"], bench.step()
        assert command.joint_names == ("insertion_joint", "rotation_joint")
        (point,) = command.points
        assert (point.positions[0], point.time_from_start) == pytest.approx((number * 0.001, 0.5))
        assert (bench.status.step, bench.status.tip_after_ns) == (number, bench.now)
    topics = ("estimate", "reduced_state", "linearized_state", "control_input")
    pose, reduced, _, control = found = [bench.published[f"needle/{t}"][-1] for t in topics]
    for message in found:
        assert (message.stamp_ns, message.frame_id) == (command.stamp_ns, "target_plane")
    assert pose.position[0] == reduced.values[0] == pytest.approx(-0.003, abs=2e-4)
    x, y, z, w = pose.orientation
    assert 2.0 * (x * z + w * y) == pytest.approx(np.sin(reduced.values[1]), abs=1e-12)
    assert point.positions[1] - before == pytest.approx(control.values[1] * 0.001)
    received = [one for s in bench.published[STATUS] for one in received_messages(s.heard)]
    assert [topic for topic, _ in received[-2:]] == ["joint_states", "device/result"]
    # A full log is published, although the status has not changed.
    number = len(bench.published[STATUS])
    for _ in range(201):
        bench.joints(**bench.position)
    logs = [received_messages(status.heard) for status in bench.published[STATUS][number:]]
    assert [len(log) for log in logs] == [100, 100]
    assert logs[1][-1] == ("joint_states", bench.now - TICK)
    assert bench.call("stop") == (True, "stopped")
    assert bench.status.state == "IDLE"


def test_a_start_requires_a_driver_that_subscribes() -> None:
    assert Bench().call("start") == (False, "no device/status received")
    for receiver in ("/recorder", "/lab/peer_topics"):
        refused = Bench(receiver=receiver).call("start")
        assert refused == (False, f"waiting for subscriber of {COMMANDS}")


def test_invalid_joints_are_reported_and_counted() -> None:
    bench = Bench()
    bench.joints(insertion=0.0)
    assert "without rotation_joint" in bench.health["joint_states"].message
    bench.joints(insertion=0.0, rotation=float("nan"))
    assert "not finite" in bench.health["joint_states"].message
    health = bench.health["joint_states"]
    assert (health.level, health.values["joint_states_refused"]) == (Level.WARN, "2")
    bench.joints(insertion=0.0, rotation=0.0)
    assert bench.health["joint_states"].level is Level.OK


def test_each_reason_to_reject_a_tip_is_logged_once_in_two_seconds() -> None:
    bench = Bench().started()
    for again in (1, 2, 3):
        for x, frame in ((float("nan"), "rig"), (0.0, "map"), (1.0, "rig")):
            bench.tip(x, frame)
        if again == 2:
            bench.later += 2.0
    assert bench.status.tips_rejected_for == "not_finite 3, frame 3, too_far 3"
    assert (bench.status.tips_rejected, bench.status.level) == (9, Level.WARN)
    for reason in ("not finite", "frame 'map'", "from the entry point"):
        assert sum(reason in line for line in bench.logs) == 2


def test_the_timer_checks_timeouts() -> None:
    bench = Bench().started()
    for _ in range(2):
        bench.do(bench.component.timers[0].handler(bench.at))
        bench.later += 3.0
    assert bench.status.state == "WAITING_FOR_TIP"


@pytest.mark.parametrize("is_used", [False, True])
def test_a_measured_heading_reaches_the_estimator_in_the_target_plane(
    is_used: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As an independent direction and its variance across; ten steps count as one."""
    settings = dataclasses.replace(
        SETTINGS, tip_covariance="from_tip_pose", measured_heading=is_used
    )
    bench, headings = Bench(settings).started(), list[tuple[float, ...]]()
    turned = m.Pose(0, "rig", (0.0,) * 3, (0.0, 0.0, math.sin(0.2), math.cos(0.2)))
    bench.receive("target_plane", turned)
    monkeypatch.setattr(
        bench.component.steering.control._estimator,
        "correct_heading",
        lambda direction, variance: headings.append((*direction, variance)),
    )
    # A turn of 0.1 rad about y; the roll is unknown.
    x, z, std = math.sin(0.1), math.cos(0.1), 0.02
    covariance = np.eye(6) * 1e-8
    covariance[3:, 3:] = std**2 * np.eye(3) + 9.0 * np.outer([x, 0.0, z], [x, 0.0, z])
    orientation = (0.0, math.sin(0.05), 0.0, math.cos(0.05))
    pose = m.PoseWithCovariance(0, "rig", (0.0,) * 3, orientation, tuple(covariance.ravel()))
    unknown = dataclasses.replace(pose, covariance=tuple((9.0 * np.eye(6)).ravel()))
    for message in (pose, pose, unknown):
        bench.step(message)
    # The first tip starts the estimator.
    wanted = [(x * math.cos(0.4), -x * math.sin(0.4), z, 10.0 * std**2)] * is_used
    np.testing.assert_allclose(headings, wanted, atol=1e-9)


def test_the_covariance_of_a_tip_is_that_of_its_position() -> None:
    pose = m.PoseWithCovariance(5, "rig", (0.0,) * 3, STRAIGHT, tuple(map(float, range(36))))
    known = tip_covariance(pose)
    np.testing.assert_array_equal(known.matrix, [[0, 1, 2], [6, 7, 8], [12, 13, 14]])


def test_the_covariance_follows_the_messages_convention(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sample of small rotations about the axes of target_plane has the published covariance."""
    bench, rng, angles = Bench().started(), np.random.default_rng(1), np.array([0.5, -0.7, 1.2])
    mean, root = rotation_from_angles(angles), rng.normal(size=(6, 6))
    estimate = pose_estimate(np.zeros(3), mean, 8.0, root @ root.T)
    monkeypatch.setattr(bench.component.steering.control._estimator, "estimate", lambda: estimate)
    bench.step()
    published = np.reshape(bench.published["needle/estimate"][-1].covariance, (6, 6))
    scale = 1e-4
    draws = rng.multivariate_normal(np.zeros(6), estimate.covariance, 20_000)
    turned = rotation_from_angles(angles + scale * draws[:, 3:]) @ mean.T
    vectors = np.stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]], axis=-1) / scale
    sampled = np.cov(np.concatenate([draws[:, :3], vectors], axis=1).T)
    np.testing.assert_allclose(sampled, published, atol=0.05 * np.max(published))


def test_invalid_targets_are_rejected_and_the_last_stays() -> None:
    bench = Bench()
    plane = m.Pose(0, "rig", (0.005, 0.0, 0.0), STRAIGHT)
    bench.receive("target_plane", plane)
    assert bench.status.target_offset_m == 0.005
    for bad, cause in (((np.nan, 0.0, 0.0), "not finite"), ((0.5, 0.0, 0.0), "cannot be reached")):
        bench.receive("target_plane", dataclasses.replace(plane, position=bad))
        assert cause in bench.health["target_plane"].message
    assert "the last valid one stays" in bench.component.problems["target_plane"]
    assert bench.status.target_offset_m == 0.005
    for x in (0.01, 0.09):
        bench.receive("target_point", m.Point(0, "rig", (x, 0.0, 0.1)))
        assert bench.status.target_point_m == (0.01, 0.0, 0.1)
    assert "from an entry at" in bench.health["target_point"].message
    # A plane replaces the point.
    bench.receive("target_plane", plane)
    assert bench.status.target_point_m is None
    assert bench.health["target_plane"].level is Level.OK
    for markers, count in (((BALL,), 1), ((dataclasses.replace(BALL, kind=1),), 1), ((), 0)):
        bench.receive("obstacles", m.Markers(markers))
        assert bench.status.obstacles == count


def test_a_path_past_obstacles_is_published_with_its_estimate() -> None:
    bench, target = Bench(), (0.0, 0.0, 0.1)
    bench.receive("target_point", m.Point(0, "rig", target))
    bench.started().step()
    assert "needle/planned_path" not in bench.published
    bench.receive("obstacles", m.Markers((BALL,)))
    bench.step()
    path = bench.published["needle/planned_path"][-1]
    assert path.stamp_ns == bench.published["needle/estimate"][-1].stamp_ns
    assert path.frame_id == "rig"
    assert math.dist(path.positions[0], (0.0, 0.0, 0.001)) < 2e-4
    assert math.dist(path.positions[-1], target) < 1e-3


def test_a_proposed_target_is_applied_when_it_is_accepted() -> None:
    bench = Bench()
    assert bench.call("accept_target") == (False, "no target on needle/proposed_target")
    bench.receive("needle/proposed_target", m.Point(7, "rig", (0.01, -0.005, 0.1)))
    bench.receive("needle/proposed_target", m.Point(8, "rig", (0.01, -0.005, 0.1)))
    assert ["proposed" in line for line in bench.logs] == [True]
    assert bench.status.target_point_m is None
    assert bench.call("accept_target") == (True, "target_point at (0.01, -0.005, 0.1) m")
    (point,) = bench.published["target_point"]
    # Stamp 0: applied as if placed by hand, also when the bag is run again.
    assert point == m.Point(0, "rig", (0.01, -0.005, 0.1))
    bench.receive("target_point", point)
    assert bench.status.target_point_m == point.position


def test_a_bad_or_forbidden_proposal_is_not_applied() -> None:
    bench = Bench()
    for frame in ("rig", "map"):
        bench.receive("needle/proposed_target", m.Point(7, frame, (0.01, 0.0, 0.1)))
    assert "frame 'map', expected 'rig'" in bench.health["needle/proposed_target"].message
    # The bad proposal withdraws the one before.
    assert bench.call("accept_target") == (False, "no target on needle/proposed_target")
    bench.receive("needle/proposed_target", m.Point(7, "rig", (0.01, 0.0, 0.1)))
    bench.set_up(depth=0.05)
    success, text = bench.call("accept_target")
    assert not success
    assert "depth is 0.05 m" in text
    assert bench.published["target_point"] == []


def test_the_motion_of_a_stamped_point_is_predicted() -> None:
    for stamped, wanted in ((True, 0.0055), (False, 0.005)):
        bench = Bench()
        for k in range(41):
            # The point drifts along x.
            stamp = k * 250_000_000 + 5_000_000_000 if stamped else 0
            bench.receive("target_point", m.Point(stamp, "rig", (0.004 + 0.25e-4 * k, 0.0, 0.09)))
        points = bench.component.steering.control._points
        assert points is not None
        np.testing.assert_allclose(points.motion.at(20.0), [wanted, 0.0, 0.09], atol=1e-7)


def test_parameters_change_while_steering() -> None:
    bench = Bench().started()
    bench.set_up(preset="open_loop")
    assert bench.status.preset == "open_loop"
    assert bench.step().points[0].positions[1] == 0.0


def test_a_path_has_several_points() -> None:
    ahead = Bench(dataclasses.replace(SETTINGS, insertion="continuous")).started()
    ahead.tip()
    points = ahead.published[COMMANDS][-1].points
    assert [point.positions[0] for point in points] == pytest.approx([0.0, 0.001, 0.002])
    assert [point.time_from_start for point in points] == pytest.approx([0.0, 0.5, 1.0])
