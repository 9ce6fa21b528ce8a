"""The particle filter as an own estimator: where it takes needles to be, late tips, frames."""

from __future__ import annotations

import math

import numpy as np
import pytest

from needle_bringup.studies.limit_study import BOUNDS, ROWS, limits
from needle_bringup.studies.particle_filter import ParticleFilter
from needle_controller.model.arrays import Array
from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.tissue import Torsion
from needle_sim.studies.disturbances import Disturbances
from needle_sim.studies.start_grids import StartBounds

CURVATURE, STEP, NOISE = 1.0 / 0.122, 0.001, 0.001


def particle_filter(wrong: Disturbances, bounds: StartBounds = BOUNDS) -> ParticleFilter:
    return ParticleFilter(CURVATURE, wrong, bounds, 3000, seed=7)


def followed(
    filter_: ParticleFilter, wrong: Disturbances, *, late: int = 0
) -> tuple[Array, list[float]]:
    """Insert a needle by 60 mm with two turns; return its pose and how far off x was, in sigmas."""
    torsion = Torsion(wrong.play, wrong.lag_length)
    plant = NeedlePlant(initial_pose(0.1, -0.3), curvature=CURVATURE)
    rng, tips, off = np.random.default_rng(3), [], []
    for k in range(61):
        if k:
            turn = 0.5 if 10 < k < 15 or 30 < k < 33 else 0.0
            plant.advance(STEP, float(torsion.advance(STEP, turn)))
            filter_.advance(STEP, turn)
        tips.append(np.array(plant.T_rig_tip[:3, 3]) + rng.uniform(-NOISE, NOISE, 3))
        if k == 0:
            filter_.reset(tips[0], [0.0, 0.0])
        elif k >= late:
            filter_.correct(tips[k - late], None, late * STEP)
        known = filter_.estimate()
        std = math.sqrt(float(known.covariance[0, 0]))
        off.append(abs(float(known.position[0] - plant.T_rig_tip[0, 3])) / std)
    return np.array(plant.T_rig_tip), off


@pytest.mark.parametrize("late", [0, 3])
@pytest.mark.parametrize(("play", "lag"), [(0.0, 0.0), (0.7, 0.0), (0.0, 0.008)])
def test_it_knows_where_the_needle_is_and_how_well(late: int, play: float, lag: float) -> None:
    wrong = Disturbances(noise=NOISE, play=play, lag_length=lag)
    filter_ = particle_filter(wrong)
    pose, off = followed(filter_, wrong, late=late)
    known = filter_.estimate()
    assert np.linalg.norm(known.position - pose[:3, 3]) < 0.0004
    assert np.arccos(known.rotation[:, 2] @ pose[:3, 2]) < math.radians(1.0)
    assert np.mean(np.array(off) < 3.0) > 0.97
    assert float(known.hypotheses.uncertainty[0]) == pytest.approx(known.covariance[0, 0])


def test_another_frame_changes_nothing_but_the_coordinates() -> None:
    wrong = Disturbances(noise=NOISE)
    filter_ = particle_filter(wrong)
    followed(filter_, wrong)
    before = filter_.estimate()
    moved = np.array(NeedlePlant(initial_pose(0.2, 0.5), curvature=0.0).T_rig_tip)
    moved[:3, 3] = [0.003, -0.001, 0.0]
    filter_.change_frame(moved)
    after = filter_.estimate()
    np.testing.assert_allclose(
        after.position, moved[:3, :3] @ before.position + moved[:3, 3], atol=1e-12
    )
    np.testing.assert_allclose(after.rotation, moved[:3, :3] @ before.rotation, atol=1e-9)


def test_a_tip_that_was_not_found_changes_nothing() -> None:
    filter_ = particle_filter(Disturbances(noise=NOISE))
    filter_.reset(np.zeros((2, 3)), np.zeros((2, 2)))
    filter_.advance(STEP, np.zeros(2))
    before = filter_.estimate()
    filter_.correct(np.full((2, 3), np.nan))
    np.testing.assert_array_equal(filter_.estimate().coordinates, before.coordinates)
    with pytest.raises(ValueError, match="d_insertion"):
        filter_.advance(-STEP, 0.0)


def test_the_limit_is_nearer_than_what_knows_less() -> None:
    rows = limits(20, 500, seed=11, only=("noise as claimed",))
    assert list(rows) == ["noise as claimed"]
    row = rows["noise as claimed"]
    assert row.limit.rms_mm < row.best.rms_mm
    assert row.limit.point_rms_mm < row.best.point_rms_mm
    assert set(rows) <= set(ROWS)
