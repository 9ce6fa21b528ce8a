"""Legs: aiming, miss distance, truncation."""

from __future__ import annotations

import math

import numpy as np
import pytest

from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles
from needle_controller.planning.legs import (
    MOST_POINTS,
    leg_length,
    leg_towards,
    trace_leg,
    truncated,
)

CURVATURE = 1.0 / 0.122
RATE = math.radians(30.0) / 0.001


def pose_of(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Array:
    pose = np.zeros((3, 4))
    pose[:, :3] = rotation_from_angles([yaw, pitch, roll])
    return pose


def test_a_leg_leads_to_its_aim() -> None:
    points, end = np.empty((MOST_POINTS, 4)), np.empty((3, 4))
    for seed in range(40):
        rng = np.random.default_rng([11, seed])
        pose = pose_of(*rng.uniform([-math.pi, -0.3, -0.3], [math.pi, 0.3, 0.3]))
        aim = pose[:, :3] @ [*rng.uniform(-0.008, 0.008, 2), rng.uniform(0.06, 0.12)]
        leg = leg_towards(pose, aim, CURVATURE, 0.8, RATE)
        count = trace_leg(pose, leg, CURVATURE, 0.01, points, end)
        assert leg.miss == leg.gentle_miss == 0.0
        assert leg.turning in (0.0, pytest.approx(abs(leg.turn) / RATE))
        assert leg.curvature <= CURVATURE
        assert abs(leg.turn) <= 1.31 * math.pi
        np.testing.assert_allclose(end[:, 3], aim, atol=1e-4)
        np.testing.assert_allclose(points[count - 1, :3], end[:, 3])
        assert points[0, 3] == 0.01
        assert points[count - 1, 3] == pytest.approx(0.01 + leg_length(leg))
        assert np.all(np.linalg.norm(np.diff(points[:count, :3], axis=0), axis=1) < 0.0101)


def test_an_aim_within_the_circle_is_missed_by_its_depth() -> None:
    # The needle bends to -y; the circle's centre is at y = -R. Here 3 mm within it.
    radius = 1.0 / CURVATURE
    inner = radius - 0.003
    aim = np.array([0.0, -radius + inner * math.cos(0.4), inner * math.sin(0.4)])
    leg = leg_towards(pose_of(), aim, CURVATURE, 0.8, RATE)
    assert leg.miss == pytest.approx(0.003, abs=1e-6)
    behind = leg_towards(pose_of(), np.array([0.0, -0.001, -0.02]), CURVATURE, 0.8, RATE)
    assert behind.miss > 0.02
    # gentle_miss is the miss with a share of the curvature.
    gentle = leg_towards(pose_of(), aim, 0.8 * CURVATURE, 1.0, RATE)
    assert leg.gentle_miss == pytest.approx(gentle.miss)
    assert leg.gentle_miss > leg.miss


def test_a_truncated_leg_continues_as_the_whole_leg() -> None:
    aim = np.array([0.006, 0.003, 0.09])
    whole = leg_towards(pose_of(), aim, CURVATURE, 0.8, RATE)
    points, end = np.empty((MOST_POINTS, 4)), np.empty((3, 4))
    for longest in (0.001, 0.01, 0.06, 1.0):
        part = truncated(whole, longest)
        assert leg_length(part) == pytest.approx(min(longest, leg_length(whole)))
        trace_leg(pose_of(), part, CURVATURE, 0.0, points, end)
        rest = leg_towards(end, aim, CURVATURE, 0.8, RATE)
        both = leg_length(part) + leg_length(rest)
        assert both == pytest.approx(leg_length(whole), abs=1e-4)
