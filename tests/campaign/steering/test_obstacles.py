"""Needles in generated scenes with obstacles: no contact, and most reach their target."""

from __future__ import annotations

import itertools
import math

import numpy as np

from campaign.steering.obstacle_scenes import ObstacleScene, clearance, make_scene
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.actions import next_step
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.plane_control import PlaneControl
from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.se3 import FloatArray

SCENES = 20
NEEDLE_RADIUS = 0.00035
CURVATURE = SteeringSettings.curvature
NOISE = 0.001
"""Largest error of a measured coordinate [m]."""
SUBSTEPS = 4


def tip_of(plant: NeedlePlant) -> FloatArray:
    return np.array(plant.T_rig_tip[:3, 3])


def steer(scene: ObstacleScene, rng: np.random.Generator) -> tuple[float, float] | None:
    """Return the miss and the least clearance of a needle [m]; None if it is not started."""
    settings = SteeringSettings(
        depth=0.2,
        entry_angle_std=math.radians(2.0),
        tip_covariance="configured",
        tip_noise="bounded",
        tip_noise_bound=NOISE,
        measurement_std=NOISE / math.sqrt(3.0),
        obstacles=tuple(float(value) for value in scene.obstacles.ravel()),
    )
    control = PlaneControl(settings)
    control.target_point = scene.target
    if control.path_problem(0.0):
        return None
    plant = NeedlePlant(initial_pose(scene.pitch, scene.roll), curvature=CURVATURE)
    joints, least = JointSample(0, 0.0, 0.0), math.inf
    for k in itertools.count(1):
        update = control.update(tip_of(plant) + rng.uniform(-NOISE, NOISE, 3), joints)
        step = None
        if update.command is not None and not update.blocked:
            step = next_step(k, joints, update.command, settings, slowly=False)
        if step is None:
            break
        length, turn = step.insertion - joints.insertion, step.rotation - joints.rotation
        for _ in range(SUBSTEPS):
            plant.advance(length / SUBSTEPS, turn / SUBSTEPS)
            least = min(least, clearance(scene.obstacles, tip_of(plant)) - NEEDLE_RADIUS)
        joints = JointSample(k, step.insertion, step.rotation)
    return float(np.linalg.norm(tip_of(plant) - scene.target)), least


def test_needles_touch_no_obstacle_and_most_reach_their_target() -> None:
    ends = [
        steer(make_scene(5, n, CURVATURE), np.random.default_rng([5, n, 1])) for n in range(SCENES)
    ]
    steered = [end for end in ends if end is not None]
    assert len(steered) > 10
    assert all(least >= 0.0 for _, least in steered)
    # Some scenes that the planner accepts have no path for a needle that is known this badly.
    assert np.mean([miss <= 1e-3 for miss, _ in steered]) > 0.7
