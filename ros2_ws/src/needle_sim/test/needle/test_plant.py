"""The plant, compared with the integrated equations of the paper, and its invariants."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.tissue import Torsion

CURVATURE = 1.0 / 0.122
TURNS = np.random.default_rng(3).uniform(-0.5, 0.5, 60)


def needle(pitch: float = 0.03, roll: float = 0.2, **more: float | Torsion | None) -> NeedlePlant:
    return NeedlePlant(initial_pose(pitch, roll), curvature=CURVATURE, **more)  # type: ignore[arg-type]


def wandering(turns: np.ndarray = TURNS) -> NeedlePlant:
    """Return a needle that was inserted by 1 mm with each turn."""
    plant = needle()
    for turned in turns:
        plant.advance(0.001, turned)
    return plant


def coordinates_rate(_: float, q: np.ndarray, rotation_rate: float) -> np.ndarray:
    """[KC09] eq. (4) with u1 = 1, q = (x, y, z, alpha, beta, gamma)."""
    _x, _y, _z, alpha, beta, gamma = q
    return np.array(
        [
            np.sin(beta),
            -np.cos(beta) * np.sin(alpha),
            np.cos(alpha) * np.cos(beta),
            CURVATURE * np.cos(gamma) / np.cos(beta),
            CURVATURE * np.sin(gamma),
            -CURVATURE * np.cos(gamma) * np.tan(beta) + rotation_rate,
        ]
    )


def test_the_plant_follows_the_coordinate_equations_of_the_paper() -> None:
    pitch, roll = np.deg2rad([2.0, 15.0])
    plant = needle(pitch, roll)
    q = np.array([0.0, 0.0, 0.0, 0.0, pitch, roll])
    rng = np.random.default_rng(4)
    for _ in range(20):
        expected = Rotation.from_euler("XYZ", q[3:]).as_matrix()
        np.testing.assert_allclose(plant.T_rig_tip[:3, 3], q[:3], rtol=0, atol=1e-10)
        np.testing.assert_allclose(plant.T_rig_tip[:3, :3], expected, rtol=0, atol=1e-8)
        length, turned = rng.uniform(0.0005, 0.004), rng.uniform(-0.3, 0.3)
        plant.advance(length, turned)
        q = solve_ivp(
            coordinates_rate, (0, length), q, args=(turned / length,), rtol=1e-11, atol=1e-13
        ).y[:, -1]


def test_moves_however_short_or_fast_leave_a_rigid_pose() -> None:
    rng = np.random.default_rng(1)
    lengths, turns = [0.0, 1.0, -1.0, 1e-320, 1e-3], [0.0, 1e5, -1e5, 1e-320]
    for lag in (0.0, 0.01):
        plant = NeedlePlant(np.eye(4), curvature=10.0, torsion=Torsion(play=0.05, lag_length=lag))
        at = np.zeros(2)
        for _ in range(150):
            to = np.array(
                [
                    rng.choice([rng.choice(lengths), rng.uniform(-1.0, 1.0)]),
                    rng.choice([rng.choice(turns), rng.uniform(-1.0, 1.0)]),
                ]
            )
            plant.advance(*(to - at))
            at = to
            turned = plant.T_rig_tip[:3, :3]
            np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-9)
            assert np.linalg.det(turned) > 0.0


def test_pure_rotation_turns_about_the_heading_and_moves_nothing() -> None:
    plant = wandering()
    before = plant.T_rig_tip
    plant.advance(0.0, 1.3)
    np.testing.assert_allclose(plant.T_rig_tip[:, 2:], before[:, 2:], atol=1e-15)
    turned = before[:3, :3].T @ plant.T_rig_tip[:3, :3]
    np.testing.assert_allclose(Rotation.from_matrix(turned).as_rotvec(), [0, 0, 1.3], atol=1e-12)


def test_splitting_a_step_changes_neither_pose_nor_torsion() -> None:
    whole, parts = needle(), needle()
    twisted, in_parts = (needle(torsion=Torsion(0.3, 0.008)) for _ in range(2))
    for turned in (0.5, 0.2, -0.9, 0.4, 0.0):
        for each in (whole, twisted):
            each.advance(0.01, turned)
        for share in (0.1, 0.25, 0.65):
            for each in (parts, in_parts):
                each.advance(share * 0.01, share * turned)
        np.testing.assert_allclose(parts.T_rig_tip, whole.T_rig_tip, rtol=0, atol=1e-14)
        assert float(in_parts.rotation) == pytest.approx(float(twisted.rotation), abs=1e-13)
    assert float(parts.insertion) == pytest.approx(0.05)


def test_retraction_follows_the_path_back_and_undone_rotation_restores_the_pose() -> None:
    reference, poses = needle(), []
    for turned in TURNS:
        poses.append(reference.T_rig_tip)
        reference.advance(0.001, turned)
    plant, undone = wandering(), wandering()
    for pose, turned in zip(poses[::-1], TURNS[::-1], strict=True):
        plant.advance(-0.001, 0.0)
        # Position and heading are those of the path; neither tip nor base is turned back.
        np.testing.assert_allclose(plant.T_rig_tip[:3, 2:], pose[:3, 2:], rtol=0, atol=1e-13)
        undone.advance(-0.001, -turned)
        np.testing.assert_allclose(undone.T_rig_tip, pose, rtol=0, atol=1e-13)
    assert float(plant.insertion) == pytest.approx(0.0, abs=1e-12)
    assert float(plant.rotation) == pytest.approx(TURNS.sum())


def test_reinsertion_follows_the_channel_and_cuts_on_from_its_end() -> None:
    plant, straight_on = wandering(), wandering()
    plant.advance(-0.03, 0.0)
    assert len(plant.centreline(0.00099)) == 32
    # 10 mm in the channel, 20 mm beyond it.
    plant.advance(0.02, 0.0)
    plant.advance(0.03, 0.0)
    straight_on.advance(0.02, 0.0)
    np.testing.assert_allclose(plant.T_rig_tip, straight_on.T_rig_tip, rtol=0, atol=1e-13)
    np.testing.assert_allclose(
        plant.centreline(0.001), straight_on.centreline(0.001), rtol=0, atol=1e-13
    )


def test_a_needle_drawn_out_turns_with_the_base_alone_and_starts_a_new_channel() -> None:
    plant = wandering()
    plant.advance(-0.062, 0.0)
    entry = initial_pose(0.03, 0.2 + TURNS.sum())
    np.testing.assert_allclose(plant.T_rig_tip[:3, 3], -0.002 * entry[:3, 2], atol=1e-15)
    np.testing.assert_allclose(plant.T_rig_tip[:3, :3], entry[:3, :3], atol=1e-12)
    assert plant.centreline(0.001).shape == (1, 3)
    plant.advance(0.002, np.pi / 2)
    fresh = needle(0.03, 0.2 + TURNS.sum() + np.pi / 2)
    for each in (plant, fresh):
        each.advance(0.03, 0.1)
    np.testing.assert_allclose(plant.T_rig_tip, fresh.T_rig_tip, atol=1e-12)


def test_the_centreline_is_the_path_at_equal_distances() -> None:
    plant = wandering()
    line = plant.centreline(0.0007)
    np.testing.assert_array_equal(line[-1], plant.T_rig_tip[:3, 3])
    np.testing.assert_allclose(line[0], 0.0, atol=1e-15)
    distance = np.linalg.norm(np.diff(line, axis=0), axis=1)
    assert distance.max() <= 0.0007
    np.testing.assert_allclose(distance, 0.06 / (len(line) - 1), rtol=1e-5)


def test_an_invalid_parameter_is_rejected_and_changes_nothing() -> None:
    plant = NeedlePlant(np.eye(4), curvature=CURVATURE)
    for inputs in ((np.nan, 0.0), (0.001, np.inf)):
        with pytest.raises(ValueError, match="finite"):
            plant.advance(*inputs)
    np.testing.assert_array_equal(plant.T_rig_tip, np.eye(4))
    many = NeedlePlant(np.tile(np.eye(4), (3, 1, 1)), curvature=CURVATURE)
    with pytest.raises(ValueError, match="cannot retract"):
        many.advance([0.0, -0.001, 0.0], 0.0)
