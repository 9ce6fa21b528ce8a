"""Obstacles on the way to a point: the closed loop, the start, and when no way on is clear."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest

from needle_controller.model.arrays import Array
from needle_controller.model.target_plane import offset_plane
from needle_controller.planning.obstacles import Obstacle, Obstacles
from needle_controller.planning.path_settings import PathSettings
from needle_controller.presets.path_steering import path_planner
from needle_controller.presets.steering_settings import PAPER_NOISE, SteeringSettings
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.next_step import next_step
from needle_controller.protocol.plane_control import PlaneControl
from needle_core.errors import UserError
from needle_sim.needle.plant import NeedlePlant, initial_pose

TARGET = (0.004, -0.006, 0.1)
# A sphere of 3 mm in the middle of the way.
SPHERE = (0.002, -0.003, 0.055, 0.002, -0.003, 0.055, 0.003)
SETTINGS = SteeringSettings(
    target_point=TARGET, depth=0.15, entry_angle_std=math.radians(2.0), **PAPER_NOISE
)
WALL = Obstacles(
    [Obstacle((-0.06, y, 0.05), (0.06, y, 0.05), 0.006) for y in np.arange(-0.07, 0.071, 0.01)]
)


def steer(
    settings: SteeringSettings, *, offset: float = 0.0, wall_at: int = 10_000
) -> tuple[Array, float, bool]:
    """Return an exact needle's tip and least clearance [m] at the end, and if it was blocked."""
    plant = NeedlePlant(initial_pose(np.deg2rad(1.0), np.deg2rad(10.0)), curvature=1 / 0.122)
    control = PlaneControl(settings, offset_plane(offset))
    assert control.path_obstacle(0.0) == ""
    rng = np.random.default_rng(5)
    joints, least = JointSample(0, 0.0, 0.0), math.inf
    for k in itertools.count():
        if k == wall_at:
            control.obstacles = WALL
        tip = plant.T_rig_tip[:3, 3]
        least = min(least, control.obstacles.clearance(tip))
        update = control.update(tip + rng.uniform(-0.001, 0.001, 3), joints)
        step = next_step(k, joints, update.command, settings, slowly=False)
        if update.blocked or step is None:
            return np.array(plant.T_rig_tip[:3, 3]), least, update.blocked
        plant.advance(step.insertion - joints.insertion, step.rotation - joints.rotation)
        joints = JointSample(k + 1, step.insertion, step.rotation)
    raise AssertionError


@pytest.mark.parametrize("offset", [0.0, 0.004])
def test_the_needle_comes_to_the_point_without_touching(offset: float) -> None:
    settings = dataclasses.replace(SETTINGS, obstacles=SPHERE, target_offset=offset)
    tip, least, blocked = steer(settings, offset=offset)
    assert not blocked
    assert np.linalg.norm(tip - TARGET) < 0.001
    assert least > 0.00035


def test_without_the_obstacle_it_would_have_touched() -> None:
    # Far away, so that the same law leads it there straight.
    far = (0.5, 0.0, 0.05, 0.5, 0.0, 0.05, 0.005)
    settings = dataclasses.replace(SETTINGS, obstacles=far)
    control = PlaneControl(dataclasses.replace(settings, obstacles=SPHERE), offset_plane(0.0))
    plant = NeedlePlant(initial_pose(np.deg2rad(1.0), np.deg2rad(10.0)), curvature=1 / 0.122)
    straight, joints, least = PlaneControl(settings, offset_plane(0.0)), JointSample(0, 0, 0), 1.0
    for k in range(90):
        tip = plant.T_rig_tip[:3, 3]
        least = min(least, control.obstacles.clearance(tip))
        step = next_step(k, joints, straight.update(tip, joints).command, settings, slowly=False)
        assert step is not None
        plant.advance(step.insertion - joints.insertion, step.rotation - joints.rotation)
        joints = JointSample(k + 1, step.insertion, step.rotation)
    assert least < 0.0


def test_a_wall_that_comes_on_the_way_stops_the_needle_before_it() -> None:
    settings = dataclasses.replace(SETTINGS, obstacles=SPHERE)
    tip, least, blocked = steer(settings, wall_at=15)
    assert blocked
    assert tip[2] < 0.044
    assert least > 0.00035


def test_a_needle_that_is_out_is_told_why_there_is_no_path() -> None:
    control = PlaneControl(SETTINGS, offset_plane(0.0))
    assert control.path_obstacle(0.0) == ""
    control.obstacles = WALL
    said = control.path_obstacle(0.0)
    assert "no path to the target point is clear of the 15 obstacles" in said
    assert "nor is one from an entry up to 0.016 m beside it" in said
    x, y, z = TARGET
    control.obstacles = Obstacles([Obstacle(TARGET, (x, y, z), 0.004)])
    assert "the target point is -0.004 m from an obstacle" in control.path_obstacle(0.0)
    control.obstacles = Obstacles([Obstacle((0.0, 0.0, 0.003), (0.0, 0.0, 0.003), 0.004)])
    assert "the entry is -0.001 m from an obstacle" in control.path_obstacle(0.0)


def test_it_is_told_from_where_there_is_a_path() -> None:
    # A wall that ends at y = 6 mm: from an entry farther in +y there is room beside it.
    half = [
        Obstacle((-0.06, y, 0.025), (0.06, y, 0.025), 0.006) for y in np.arange(-0.07, 0.001, 0.01)
    ]
    control = PlaneControl(SETTINGS, offset_plane(0.0))
    control.target_point = np.array([0.0, 0.008, 0.1])
    control.obstacles = Obstacles(half)
    said = control.path_obstacle(0.0)
    assert "in place of (0, 0) there is one" in said
    x, y = (float(part) for part in said.split("entering at (")[1].split(") m")[0].split(","))
    assert y > 0.0
    moved = Obstacles(
        [
            Obstacle((a - x, b - y, c), (d - x, e - y, f), r)
            for a, b, c, d, e, f, r in control.obstacles.table.tolist()
        ]
    )
    control.obstacles = moved
    control.target_point = np.array([-x, 0.008 - y, 0.1])
    assert control.path_obstacle(0.0) == ""


def test_obstacles_change_with_the_settings_and_stay_with_others() -> None:
    control = PlaneControl(SETTINGS, offset_plane(0.0))
    control.obstacles = WALL
    control.configure(dataclasses.replace(SETTINGS, max_rotation_per_length=300.0))
    assert len(control.obstacles) == len(WALL)
    control.configure(dataclasses.replace(SETTINGS, obstacles=SPHERE))
    assert len(control.obstacles) == 1
    with pytest.raises(UserError, match="obstacles has 6 numbers"):
        dataclasses.replace(SETTINGS, obstacles=SPHERE[:6])


def test_obstacles_are_cleared_by_the_needle_at_hand() -> None:
    thick = SteeringSettings(needle_diameter=0.002)
    assert path_planner(thick).settings.needle_radius == 0.001
    assert path_planner(SteeringSettings()).settings == PathSettings(
        max_rotation_per_length=thick.max_rotation_per_length, longest=thick.depth
    )


@pytest.mark.parametrize("depth", [0.0, 1e-5, 1.0])
def test_every_depth_that_a_parameter_may_have_is_one_of_the_planner(depth: float) -> None:
    control = PlaneControl(SteeringSettings(), offset_plane(0.0))
    control.configure(SteeringSettings(depth=depth))
    assert path_planner(SteeringSettings(depth=depth)).settings.longest == depth
