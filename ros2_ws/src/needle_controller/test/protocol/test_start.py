"""Conditions for a start, and changes of settings."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from needle_controller.model.target_plane import plane_from_pose
from needle_controller.planning.obstacles import Obstacle, Obstacles
from needle_controller.planning.path_planner import PathPlanner
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.actions import Awaiting, SteeringState
from needle_controller.protocol.steering import Steering

from .rig import HOLD, MOVING, TICK, Rig, device, logged, none_sent, sent, state_of

SETTINGS = SteeringSettings(target_offset=0.003, tip_covariance="configured")


def test_start_reports_the_missing_device_state() -> None:
    bare = Steering(SETTINGS)
    assert (bare.step, bare.insertion, bare.command_ns, bare.watchdog_trips) == (0, 0.0, 0, 0)
    assert "no device/status received" in bare.on_start()[0].message
    bare.on_device(HOLD)
    assert bare.on_start()[0].message == "no joint_states received"
    rig = Rig(started=False)
    for status, cause in (
        (MOVING, "waiting for the device to stop"),
        (device("MOVING", False), "waiting for the device to stop"),
        (device("HOLDING", False), "not homed"),
        (device("DISABLED"), "not enabled (DISABLED)"),
        (device("ESTOPPED"), "not enabled (ESTOPPED)"),
    ):
        rig.steering.on_device(status)
        assert cause in rig.start()
        assert state_of(rig) == (SteeringState.IDLE, Awaiting.NOTHING)


@pytest.mark.parametrize(
    ("insertion", "rotation", "agree"),
    [(4.9e-5, -1.9e-2, True), (5.1e-5, 0.0, False), (0.0, 2.1e-2, False), (None, 0.0, True)],
)
def test_start_waits_until_joints_and_device_agree(
    insertion: float | None, rotation: float, agree: bool
) -> None:
    """The joints lag behind the device's status after homing; a status without them agrees."""
    rig = Rig(started=False)
    status = dataclasses.replace(HOLD, insertion_m=insertion, rotation_rad=rotation)
    rig.steering.on_device(status)
    assert ("waiting for joint_states to agree" not in rig.start()) is agree
    if not agree:
        rig.insertion, rig.rotation = insertion or 0.0, rotation
        rig.settle()
        assert rig.start() == "steering"


def test_start_is_refused_for_an_inserted_or_rolled_needle() -> None:
    assert Rig(started=False, insertion=0.002).start() == "steering"
    assert "is 0.0021 m in, on an unknown path" in Rig(started=False, insertion=0.0021).start()
    for short, cause in ((0.9e-6, "has reached the depth 0.001 m"), (1.1e-6, "steering")):
        assert cause in Rig(started=False, depth=0.001, insertion=0.001 - short).start()
    for degrees, started in ((79.0, True), (-79.0, True), (81.0, False), (-81.0, False)):
        reply = Rig(started=False, preset="paper", rotation=math.radians(degrees)).start()
        assert ("roll in target_plane" not in reply) is started, degrees
    assert reply == (
        "the needle's roll in target_plane is -1.41 rad (rotation_joint -1.414 rad), "
        "must be within 1.4 rad"
    )
    rig = Rig(started=False, preset="paper")
    rig.steering.control.plane = plane_from_pose("rig", [0.0] * 3, [0.0, 0.0, *[np.sqrt(0.5)] * 2])
    assert "is -1.57 rad (rotation_joint 0 rad)" in rig.start()
    # Preset best has no limit.
    assert Rig(started=False, rotation=-8.0).start() == "steering"


def test_start_and_stop_are_idempotent() -> None:
    rig = Rig(started=False)
    # Tips cause no motion before a start.
    assert rig.expose() == []
    assert rig.steering.starts == 0
    assert rig.start() == "steering"
    assert rig.start() == "already steering"
    assert rig.steering.starts == 1
    rig.steps(5)
    # A stop clears the queue of tips.
    rig.steering.on_tip(rig.measured(ahead=TICK))
    for text in ("stopped", "was not steering (IDLE)"):
        reply, _ = rig.steering.on_stop()
        assert (reply.success, reply.message) == (True, text)
        assert state_of(rig) == (SteeringState.IDLE, Awaiting.NOTHING)
    # Steering continues with the old estimate.
    assert rig.start() == "steering"
    assert none_sent(rig.settle(1))
    assert sent(rig.expose()).insertion == pytest.approx(0.006)
    assert (rig.steering.step, rig.steering.starts) == (5, 2)


def test_a_needle_that_is_out_restarts_the_estimate() -> None:
    rig = Rig()
    rig.steps(2)
    rig.steering.on_stop()
    assert rig.start() == "steering"
    assert rig.steering.step == 0
    assert not rig.steering.control.started
    assert rig.steering.tips.last is None


def test_start_is_refused_without_a_path_past_obstacles(monkeypatch: pytest.MonkeyPatch) -> None:
    # The search for another entry is tested with the planner.
    monkeypatch.setattr(PathPlanner, "nearest_entry", lambda *_: None)
    rig, target = Rig(started=False), (0.0, 0.0, 0.06)
    control = rig.steering.control
    control.target_point = np.array(target)
    control.obstacles = Obstacles([Obstacle(target, target, 0.004)])
    assert "the target point is" in rig.start()
    # A new obstacle stops the needle.
    control.obstacles = Obstacles([Obstacle((0.05, 0.0, 0.02), (0.05, 0.0, 0.02), 0.001)])
    assert rig.start() == "steering"
    rig.steps(2)
    wall = [Obstacle((-0.06, y, 0.03), (0.06, y, 0.03), 0.02) for y in (-0.03, 0.0, 0.03)]
    control.obstacles = Obstacles(wall)
    while not none_sent(actions := rig.expose()):
        rig.run(sent(actions))
    assert "IDLE: no path from insertion 0.0" in logged(actions)
    assert state_of(rig) == (SteeringState.IDLE, Awaiting.NOTHING)
    problem = control.path_problem(0.0)
    assert "no path to the target point is clear of the 3 obstacles, nor from any entry" in problem
