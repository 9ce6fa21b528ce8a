"""The particle filter as an own estimator: where it takes needles to be, late tips, frames."""

from __future__ import annotations

import math

import numpy as np
import pytest

from needle_bringup.studies import limit_study
from needle_bringup.studies.limit_study import BOUNDS, ROWS, limits
from needle_bringup.studies.particle_filter import ParticleFilter
from needle_controller.model.arrays import Array
from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.tissue import Torsion
from needle_sim.studies.disturbances import Disturbances

pytestmark = pytest.mark.usefixtures("compiled")
CURVATURE, STEP, NOISE = 1.0 / 0.122, 0.001, 0.001


def particle_filter(wrong: Disturbances, particles: int = 1500) -> ParticleFilter:
    return ParticleFilter(CURVATURE, wrong, BOUNDS, particles, np.random.default_rng(7))


def followed(filter_: ParticleFilter, wrong: Disturbances, late: int = 0) -> tuple[Array, float]:
    """Insert a needle by 60 mm with two turns; return its pose and how often x was within 3 sigma.

    A tip of ten is far off where there are outliers.
    """
    torsion = Torsion(wrong.play, wrong.lag_length)
    plant = NeedlePlant(initial_pose(0.1, -0.3), curvature=CURVATURE)
    rng, tips, within = np.random.default_rng(3), [], []
    for k in range(61):
        if k:
            turn = 0.5 if 10 < k < 15 or 30 < k < 33 else 0.0
            plant.advance(STEP, float(torsion.advance(STEP, turn)))
            filter_.advance(STEP, turn)
        off = rng.uniform(-NOISE, NOISE, 3)
        if wrong.noise_shape == "normal":
            off = rng.normal(0.0, NOISE, 3)
        if wrong.outliers and k % 10 == 5:
            off = np.array([0.003, 0.0, 0.0])
        tips.append(np.array(plant.T_rig_tip[:3, 3]) + off)
        if k == 0:
            filter_.reset(tips[0], [0.0, 0.0])
        elif k >= late:
            filter_.correct(tips[k - late], None, late * STEP)
        known = filter_.estimate()
        std = math.sqrt(float(known.covariance[0, 0]))
        within.append(abs(float(known.position[0] - plant.T_rig_tip[0, 3])) < 3.0 * std)
    return np.array(plant.T_rig_tip), float(np.mean(within))


@pytest.mark.parametrize(
    ("late", "wrong"),
    [
        (0, Disturbances(noise=NOISE, play=0.7)),
        (3, Disturbances(noise=NOISE, lag_length=0.008)),
        (0, Disturbances(noise=NOISE, noise_shape="normal")),
        (0, Disturbances(noise=NOISE, outliers=0.1, outlier_size=(0.002, 0.0035))),
    ],
    ids=["play", "lag, late tips", "normal noise", "outliers"],
)
def test_it_knows_where_the_needle_is_and_how_well(late: int, wrong: Disturbances) -> None:
    filter_ = particle_filter(wrong)
    pose, within = followed(filter_, wrong, late)
    known = filter_.estimate()
    assert np.linalg.norm(known.position - pose[:3, 3]) < 0.0006
    assert np.arccos(known.rotation[:, 2] @ pose[:3, 2]) < math.radians(1.0)
    assert within > 0.97
    assert known.hypotheses is not None
    assert float(known.hypotheses.uncertainty[0]) == pytest.approx(known.covariance[0, 0])


def test_another_frame_changes_nothing_but_the_coordinates() -> None:
    wrong = Disturbances(noise=NOISE)
    filter_ = particle_filter(wrong, 500)
    followed(filter_, wrong)
    before = filter_.estimate()
    moved = np.array(NeedlePlant(initial_pose(0.2, 0.5), curvature=0.0).T_rig_tip)
    moved[:3, 3] = [0.003, -0.001, 0.0]
    filter_.change_frame(moved)
    after = filter_.estimate()
    place = moved[:3, :3] @ before.position + moved[:3, 3]
    np.testing.assert_allclose(after.position, place, atol=1e-12)
    np.testing.assert_allclose(after.rotation, moved[:3, :3] @ before.rotation, atol=1e-9)


def test_a_tip_that_was_not_found_changes_nothing() -> None:
    filter_ = particle_filter(Disturbances(noise=NOISE), 500)
    filter_.reset(np.zeros(3), np.zeros(2))
    filter_.advance(STEP, 0.0)
    before = filter_.estimate()
    filter_.correct(np.full(3, np.nan))
    np.testing.assert_array_equal(filter_.estimate().coordinates, before.coordinates)
    with pytest.raises(ValueError, match="d_insertion"):
        filter_.advance(-STEP, 0.0)


@pytest.fixture(scope="module")
def reached() -> limit_study.LimitRow:
    (row,) = limits(20, 500, seed=11, only=("noise as claimed",)).values()
    return row


def test_the_limit_is_nearer_than_what_knows_less(
    reached: limit_study.LimitRow,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert reached.limit.rms_mm < reached.best.rms_mm
    assert reached.limit.point_rms_mm < reached.best.point_rms_mm
    monkeypatch.setattr(limit_study, "limits", lambda *given: {given[3][0]: reached})
    assert limit_study.main() == 0
    said = capsys.readouterr().out
    assert all(label in said for label in ROWS)
