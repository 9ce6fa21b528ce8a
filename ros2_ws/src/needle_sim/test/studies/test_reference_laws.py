"""The published laws: sliding mode, and RRT with its arcs, duty cycle and paths past obstacles."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.reference_laws import DutyCycle, plan, sliding_mode_rate

CURVATURE = 1.0 / 0.122
RATE = np.deg2rad(30.0) / 0.001
STEP = 0.001
TARGET = np.array([0.006, 0.004, 0.11])
BALL = np.array([[0.002, 0.001, 0.05, 0.002, 0.001, 0.05, 0.003]])
FREE = np.zeros((0, 7))


def steered(rate: Callable[[FloatArray], float], length: float) -> tuple[float, float]:
    """Return the miss of an exact needle and its least distance from the ball [m]."""
    plant, least = NeedlePlant(initial_pose(0.02, 0.3), curvature=CURVATURE), 1.0
    pose = plant.T_rig_tip
    while (ahead := float(pose[:3, 2] @ (TARGET - pose[:3, 3]))) > 1e-5:
        step = min(length, ahead)
        plant.advance(step, rate(pose) * step)
        pose = plant.T_rig_tip
        least = min(least, float(np.linalg.norm(pose[:3, 3] - BALL[0, :3])) - BALL[0, 6])
    return float(np.linalg.norm(pose[:3, 3] - TARGET)), least


def sliding(pose: FloatArray) -> float:
    return float(sliding_mode_rate(pose[:3, :3].T @ (TARGET - pose[:3, 3]), RATE))


def test_sliding_mode_takes_the_shorter_turn_and_is_as_accurate_as_published() -> None:
    for aside in ((1.0, 0.0), (-1.0, 0.0), (0.5, -2.0), (-0.1, 1.0)):
        plant = NeedlePlant(initial_pose(0.0, 0.0), curvature=CURVATURE)
        target = np.array([*aside, 50.0]) * 1e-3
        plant.advance(0.0, float(sliding_mode_rate(target, RATE)) * 1e-4)
        towards = np.array(aside) / np.hypot(*aside)
        assert -plant.T_rig_tip[:2, 1] @ towards > np.array([0.0, -1.0]) @ towards
    # At 30 deg/mm and this curvature the bound is 0.41 mm, for steps far shorter than a turn.
    assert steered(sliding, 2e-4)[0] < 0.00041


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_duty_cycle_spins_for_the_straight_share(share: float) -> None:
    cycle, steps = DutyCycle(RATE, STEP), 600
    ahead = np.array([[0.0, -1.0, share]])
    turned = sum(abs(float(cycle.rates(ahead)[0])) * STEP for _ in range(steps))
    assert turned == pytest.approx((1.0 - share) * steps * RATE * STEP, abs=2.0 * np.pi)


@pytest.mark.parametrize("obstacles", [FREE, BALL], ids=["free", "ball"])
def test_a_planned_needle_reaches_its_target_past_an_obstacle(obstacles: FloatArray) -> None:
    rng, cycle, arc = np.random.default_rng(4), DutyCycle(RATE, STEP), np.zeros(3)

    def planned(pose: FloatArray) -> float:
        chance = rng.random((100, 4))
        place, rotation = pose[:3, 3].copy(), pose[:3, :3].copy()
        plan(place, rotation, TARGET, obstacles, CURVATURE, 0.001, chance, arc)
        return float(cycle.rates(arc[np.newaxis])[0])

    miss, least = steered(planned, STEP)
    assert miss < 0.001
    # Without the obstacle the needle would pass through the ball.
    assert (least > 0.0) == bool(len(obstacles))
