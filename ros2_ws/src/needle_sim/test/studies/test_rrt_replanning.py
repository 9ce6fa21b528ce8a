"""The reference planner: its arcs, its duty cycle, its paths past obstacles, what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.rrt_replanning import SAMPLES, DutyCycle, arc_to, is_clear, move, plan

CURVATURE = 1.0 / 0.122
RATE = np.deg2rad(30.0) / 0.001
STEP = 0.001
TARGET = np.array([0.006, 0.004, 0.11])
BALL = np.array([[0.002, 0.001, 0.05, 0.002, 0.001, 0.05, 0.003]])
FREE = np.zeros((0, 7))


def test_an_arc_ends_where_it_is_to_and_is_the_needle_s_own_at_the_edge() -> None:
    plant = NeedlePlant(initial_pose(0.1, 0.4), curvature=CURVATURE)
    pose = np.array(plant.T_rig_tip)
    plant.advance(0.06, 0.0)
    there, bend, end, heading = plant.T_rig_tip, np.empty(3), np.empty(3), np.empty(3)
    goal = np.array(there[:3, 3])
    length = arc_to(pose[:3, 3].copy(), pose[:3, 2].copy(), goal, 1.001 * CURVATURE, bend)
    assert length == pytest.approx(0.06)
    np.testing.assert_allclose(bend, -CURVATURE * pose[:3, 1], atol=1e-9)
    move(pose[:3, 3].copy(), pose[:3, 2].copy(), bend, length, end, heading)
    np.testing.assert_allclose(end, goal, atol=1e-12)
    np.testing.assert_allclose(heading, there[:3, 2], atol=1e-9)
    assert np.isinf(arc_to(pose[:3, 3].copy(), pose[:3, 2].copy(), goal, 0.99 * CURVATURE, bend))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.8, 1.0])
def test_a_duty_cycle_spins_for_the_share_that_is_not_to_bend(share: float) -> None:
    cycle, steps = DutyCycle(RATE, STEP), 2400
    ahead = np.array([[0.0, -1.0, share]])
    turned = sum(abs(float(cycle.rates(ahead)[0])) * STEP for _ in range(steps))
    assert turned == pytest.approx((1.0 - share) * steps * RATE * STEP, abs=2.0 * np.pi)


def steered(obstacles: FloatArray) -> tuple[float, float]:
    """Return an exact needle's miss and its least distance from the first obstacle [m]."""
    rng, cycle = np.random.default_rng(4), DutyCycle(RATE, STEP)
    plant, arc, least = NeedlePlant(initial_pose(0.02, 0.3), curvature=CURVATURE), np.zeros(3), 1.0
    for _ in range(200):
        pose = np.array(plant.T_rig_tip)
        ahead = float(pose[:3, 2] @ (TARGET - pose[:3, 3]))
        if ahead <= 1e-5:
            break
        chance = rng.random((SAMPLES, 4))
        plan(
            pose[:3, 3].copy(),
            pose[:3, :3].copy(),
            TARGET,
            obstacles,
            CURVATURE,
            0.001,
            chance,
            arc,
        )
        length = min(STEP, ahead)
        plant.advance(length, float(cycle.rates(arc[np.newaxis])[0]) * length)
        least = min(least, float(np.linalg.norm(plant.T_rig_tip[:3, 3] - BALL[0, :3])) - BALL[0, 6])
    return float(np.linalg.norm(plant.T_rig_tip[:3, 3] - TARGET)), least


def test_an_exact_needle_comes_within_a_millimetre() -> None:
    miss, least = steered(FREE)
    assert miss < 0.001
    assert least < 0.0, "else the ball is in nobody's way"


def test_it_leads_past_what_is_in_the_way() -> None:
    miss, least = steered(BALL)
    assert miss < 0.003
    assert least > 0.0


def test_what_no_path_leads_to_is_said() -> None:
    arc, chance = np.full(3, 7.0), np.random.default_rng(5).random((SAMPLES, 4))
    aside = np.array([0.05, 0.0, 0.02])
    assert not plan(np.zeros(3), np.eye(3), aside, FREE, CURVATURE, 0.001, chance, arc)
    np.testing.assert_array_equal(arc, 7.0)
    straight, bend = np.array([0.0, 0.0, 1.0]), np.zeros(3)
    assert is_clear(np.zeros(3), straight, bend, 0.03, BALL, 0.001)
    assert not is_clear(np.zeros(3), straight, bend, 0.05, BALL, 0.001)
