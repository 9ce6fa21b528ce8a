"""Exact needles with noisy tips, and a filter that follows them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from exact_needle import moved
from needle_controller.filter.filter_settings import TorsionHypothesis
from needle_controller.filter.hypothesis_filter import HypothesisFilter
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles
from needle_controller.observers.estimator import Estimate

CURVATURE = 1.0 / 0.122
STEP = 0.001
RIGID = (TorsionHypothesis(0.0, 0.0, 0.0, 1.0, heading_drift=0.03, roll_drift=0.03),)


def path(
    turns: Array,
    pitch: float = 0.0,
    roll: float = 0.0,
    curvature: float = CURVATURE,
    play: float = 0.0,
    lag: float = 0.0,
    start: npt.ArrayLike = (0.0, 0.0, 0.0),
) -> Array:
    """Poses (len(turns) + 1, 4, 4) of an exact needle, tip turned through play and lag."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles([0.0, pitch, roll])
    pose[:3, 3] = start
    poses, base, behind, tip = [pose], 0.0, 0.0, 0.0
    for turn in turns:
        before = tip
        parts = 200 if play or lag else 1
        for _ in range(parts):
            base += turn / parts
            behind = min(max(behind, base - play), base + play)
            tip = tip + (behind - tip) * (1 - np.exp(-STEP / parts / lag)) if lag else behind
        pose = moved(pose, STEP, tip - before, curvature)
        poses.append(pose)
    return np.array(poses)


def turns_for(count: int, seed: int = 5, size: float = 0.3) -> Array:
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-size, size, count // 4 + 1), 4)[:count]


def drive(
    estimator: HypothesisFilter,
    turns: Array,
    tips: Array,
    covariance: Array | None = None,
    *,
    age: float = 0.0,
    step: float = STEP,
) -> Estimate:
    estimator.reset(tips[0], np.zeros(2))
    for turn, tip in zip(turns, tips[1:], strict=True):
        estimator.advance(step, turn)
        estimator.correct(tip, covariance, age)
    return estimator.estimate()


def noisy(poses: Array, seed: int = 6, bound: float = 0.001) -> Array:
    tips = poses[:, :3, 3]
    return tips + np.random.default_rng(seed).uniform(-bound, bound, tips.shape)


def rotation_error(estimate: Estimate, pose: Array) -> float:
    return float(np.rad2deg(Rotation.from_matrix(estimate.rotation @ pose[:3, :3].T).magnitude()))
