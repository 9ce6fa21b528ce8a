"""The plant against the paper's equations, integrated by somebody else, and its own invariants."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.tissue import Torsion

CURVATURE = 1.0 / 0.122


def inserted(plant: NeedlePlant, steps: int, turned: float = 0.0) -> NeedlePlant:
    for _ in range(steps):
        plant.advance(0.001, turned)
    return plant


def wandering(seed: int = 3, steps: int = 100, torsion: Torsion | None = None) -> NeedlePlant:
    plant = NeedlePlant(initial_pose(0.03, 0.2), curvature=CURVATURE, torsion=torsion)
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        plant.advance(0.001, rng.uniform(-0.5, 0.5))
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


def test_follows_the_paper_s_coordinate_equations() -> None:
    pitch, roll = np.deg2rad([2.0, 15.0])
    plant = NeedlePlant(initial_pose(pitch, roll), curvature=CURVATURE)
    q = np.array([0.0, 0.0, 0.0, 0.0, pitch, roll])
    rng = np.random.default_rng(4)
    for _ in range(30):
        length, turned = rng.uniform(0.0005, 0.004), rng.uniform(-0.3, 0.3)
        plant.advance(length, turned)
        q = solve_ivp(
            coordinates_rate, (0, length), q, args=(turned / length,), rtol=1e-11, atol=1e-13
        ).y[:, -1]
        pose = plant.T_rig_tip
        np.testing.assert_allclose(pose[:3, 3], q[:3], rtol=0, atol=1e-10)
        expected = Rotation.from_euler("XYZ", q[3:]).as_matrix()
        np.testing.assert_allclose(pose[:3, :3], expected, rtol=0, atol=1e-8)


def test_initial_pose_is_pitch_then_roll_at_the_entry() -> None:
    pose = initial_pose(0.1, 0.4)
    np.testing.assert_allclose(
        pose[:3, :3], Rotation.from_euler("XYZ", [0, 0.1, 0.4]).as_matrix(), atol=1e-15
    )
    assert pose[0, 2] == pytest.approx(np.sin(0.1))
    np.testing.assert_array_equal(pose[:, 3], [0, 0, 0, 1])


def test_stays_rigid_over_many_steps() -> None:
    plant = NeedlePlant(np.eye(4), curvature=CURVATURE)
    for _ in range(10_000):
        plant.advance(0.0001, 0.01)
    rotation = plant.T_rig_tip[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-12)


def test_pure_insertion_is_a_circle_towards_minus_y() -> None:
    plant = inserted(NeedlePlant(np.eye(4), curvature=CURVATURE), 120)
    line = plant.centreline(0.0007)
    centre = np.array([0.0, -1.0 / CURVATURE, 0.0])
    np.testing.assert_allclose(np.linalg.norm(line - centre, axis=1), 1 / CURVATURE, atol=1e-13)
    assert np.all(np.diff(line[:, 1]) < 0.0)
    assert np.all(line[:, 0] == 0.0)


def test_open_loop_misses_the_plane_by_what_was_measured_before() -> None:
    plant = NeedlePlant(initial_pose(*np.deg2rad([2.0, 15.0])), curvature=CURVATURE)
    r1_mm = 1e3 * inserted(plant, 120).T_rig_tip[0, 3] - 3.0
    assert r1_mm == pytest.approx(14.62, abs=0.01)


def test_pure_rotation_turns_about_the_heading_and_moves_nothing() -> None:
    plant = inserted(NeedlePlant(initial_pose(0.1, 0.2), curvature=CURVATURE), 20)
    before = plant.T_rig_tip
    plant.advance(0.0, 1.3)
    np.testing.assert_allclose(plant.T_rig_tip[:, 2:], before[:, 2:], atol=1e-15)
    turned = before[:3, :3].T @ plant.T_rig_tip[:3, :3]
    np.testing.assert_allclose(Rotation.from_matrix(turned).as_rotvec(), [0, 0, 1.3], atol=1e-12)


def test_splitting_a_step_changes_nothing() -> None:
    whole = NeedlePlant(initial_pose(0.1, 0.2), curvature=CURVATURE)
    parts = NeedlePlant(initial_pose(0.1, 0.2), curvature=CURVATURE)
    for turned in (0.3, -0.2, 0.0):
        whole.advance(0.01, turned)
        for share in (0.1, 0.25, 0.65):
            parts.advance(share * 0.01, share * turned)
    np.testing.assert_allclose(parts.T_rig_tip, whole.T_rig_tip, rtol=0, atol=1e-14)
    assert parts.insertion == pytest.approx(whole.insertion)


def test_retraction_returns_along_the_path() -> None:
    plant = wandering()
    rng = np.random.default_rng(3)
    reference = NeedlePlant(initial_pose(0.03, 0.2), curvature=CURVATURE)
    poses = [reference.T_rig_tip]
    for _ in range(100):
        reference.advance(0.001, rng.uniform(-0.5, 0.5))
        poses.append(reference.T_rig_tip)
    for pose in poses[-2::-1]:
        plant.advance(-0.001, 0.0)
        # Position and heading are the path's; the tip is not turned back, for the base is not.
        np.testing.assert_allclose(plant.T_rig_tip[:3, 2:], pose[:3, 2:], rtol=0, atol=1e-13)
    assert float(plant.insertion) == pytest.approx(0.0, abs=1e-12)


def test_retraction_with_the_rotation_undone_returns_the_whole_pose() -> None:
    plant = NeedlePlant(initial_pose(0.03, 0.2), curvature=CURVATURE)
    poses = []
    for turned in (0.4, -0.1, 0.2):
        poses.append(plant.T_rig_tip)
        plant.advance(0.005, turned)
    for turned, pose in zip((-0.2, 0.1, -0.4), poses[::-1], strict=True):
        plant.advance(-0.005, turned)
        np.testing.assert_allclose(plant.T_rig_tip, pose, rtol=0, atol=1e-14)


def test_a_needle_drawn_back_keeps_its_roll_as_the_base_does() -> None:
    plant = NeedlePlant(np.eye(4), curvature=0.0)
    plant.advance(0.02, 0.7)
    plant.advance(-0.01, 0.0)
    turned = Rotation.from_matrix(plant.T_rig_tip[:3, :3]).as_rotvec()
    np.testing.assert_allclose(turned, [0, 0, 0.7], atol=1e-13)


def test_reinsertion_follows_the_channel_and_cuts_on_from_its_end() -> None:
    plant, straight_on = wandering(), wandering()
    plant.advance(-0.03, 0.0)
    assert len(plant.centreline(0.00099)) == 72
    plant.advance(0.02, 0.0)
    plant.advance(0.03, 0.0)  # 10 mm in the channel, 20 mm beyond
    straight_on.advance(0.02, 0.0)
    np.testing.assert_allclose(plant.T_rig_tip, straight_on.T_rig_tip, rtol=0, atol=1e-13)
    np.testing.assert_allclose(
        plant.centreline(0.001), straight_on.centreline(0.001), rtol=0, atol=1e-13
    )


def test_moves_however_short_or_fast_leave_a_pose() -> None:
    rng = np.random.default_rng(1)
    lengths, turns = [0.0, 1.0, -1.0, 1e-320, 1e-3], [0.0, 1e5, -1e5, 1e-320]
    for lag in (0.0, 0.01):
        needle = NeedlePlant(np.eye(4), curvature=10.0, torsion=Torsion(play=0.05, lag_length=lag))
        at = np.zeros(2)
        for _ in range(2000):
            to = np.array(
                [
                    rng.choice([rng.choice(lengths), rng.uniform(-1.0, 1.0)]),
                    rng.choice([rng.choice(turns), rng.uniform(-1.0, 1.0)]),
                ]
            )
            needle.advance(*(to - at))
            at = to
            turned = needle.T_rig_tip[:3, :3]
            np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-9)


def test_a_needle_drawn_out_starts_a_new_channel() -> None:
    plant = inserted(NeedlePlant(initial_pose(0.1, 0.2), curvature=CURVATURE), 30)
    plant.advance(-0.032, 0.0)
    heading = initial_pose(0.1, 0.2)[:3, 2]
    np.testing.assert_allclose(plant.T_rig_tip[:3, 3], -0.002 * heading, atol=1e-15)
    assert plant.centreline(0.001).shape == (1, 3)
    plant.advance(0.002, np.pi / 2)
    np.testing.assert_allclose(plant.T_rig_tip, initial_pose(0.1, 0.2 + np.pi / 2), atol=1e-12)
    fresh = NeedlePlant(initial_pose(0.1, 0.2 + np.pi / 2), curvature=CURVATURE)
    np.testing.assert_allclose(
        inserted(plant, 30).T_rig_tip, inserted(fresh, 30).T_rig_tip, atol=1e-12
    )


def test_outside_the_tip_turns_with_the_base_alone() -> None:
    plant = inserted(NeedlePlant(initial_pose(0.1, 0.2), curvature=CURVATURE), 30, 0.02)
    for _ in range(35):
        plant.advance(-0.001, 0.0)
    expected = initial_pose(0.1, 0.2 + 0.6)
    np.testing.assert_allclose(plant.T_rig_tip[:3, :3], expected[:3, :3], atol=1e-12)
    np.testing.assert_allclose(plant.T_rig_tip[:3, 3], -0.005 * expected[:3, 2], atol=1e-12)


def test_increments_that_do_not_add_up_to_zero_still_leave_the_channel() -> None:
    plant = NeedlePlant(np.eye(4), curvature=CURVATURE)
    for _ in range(10):
        plant.advance(0.001, 0.1)
    plant.advance(-0.01 + 2e-7, -1.0)
    assert plant.centreline(0.001).shape == (2, 3)
    plant.advance(0.01, 0.0)
    fresh = NeedlePlant(np.eye(4), curvature=CURVATURE)
    fresh.advance(0.01 + 2e-7, 0.0)
    np.testing.assert_allclose(plant.T_rig_tip, fresh.T_rig_tip, rtol=0, atol=1e-5)
    assert float(np.abs(plant.centreline(0.001)[:, 0]).max()) < 1e-9


def test_centreline_is_the_path_at_equal_distances() -> None:
    plant = wandering()
    line = plant.centreline(0.0007)
    np.testing.assert_array_equal(line[-1], plant.T_rig_tip[:3, 3])
    np.testing.assert_allclose(line[0], 0.0, atol=1e-15)
    distance = np.linalg.norm(np.diff(line, axis=0), axis=1)
    assert distance.max() <= 0.0007
    np.testing.assert_allclose(distance, 0.1 / (len(line) - 1), rtol=1e-5)


def test_broadcasting_equals_looping() -> None:
    rng = np.random.default_rng(5)
    starts = np.stack([initial_pose(p, r) for p, r in rng.uniform(-0.3, 0.3, (6, 2))])
    curvature = rng.uniform(5.0, 10.0, (2, 3))
    inputs = rng.uniform([0.0, -0.5], [0.002, 0.5], (10, 2, 3, 2))
    play, lag = rng.uniform(0.0, 0.2, (2, 3)), np.array([[0.0, 0.004, 0.01]])
    many = NeedlePlant(starts.reshape(2, 3, 4, 4), curvature=curvature, torsion=Torsion(play, lag))
    for each in inputs:
        many.advance(each[..., 0], each[..., 1])
    for index in np.ndindex(2, 3):
        one = NeedlePlant(
            starts.reshape(2, 3, 4, 4)[index],
            curvature=curvature[index],
            torsion=Torsion(play[index], lag[0, index[1]]),
        )
        for each in inputs:
            one.advance(*each[index])
        np.testing.assert_allclose(many.T_rig_tip[index], one.T_rig_tip, rtol=0, atol=1e-14)
        assert many.insertion[index] == pytest.approx(float(one.insertion))
        assert many.rotation[index] == pytest.approx(float(one.rotation))


def test_bicycle_tip_rides_ahead_of_the_rear_wheel() -> None:
    offset = 0.01
    rear = wandering()
    ahead = np.eye(4)
    ahead[2, 3] = offset
    tip = NeedlePlant(initial_pose(0.03, 0.2) @ ahead, curvature=CURVATURE, tip_offset=offset)
    rng = np.random.default_rng(3)
    for _ in range(100):
        tip.advance(0.001, rng.uniform(-0.5, 0.5))
    np.testing.assert_allclose(tip.T_rig_tip, rear.T_rig_tip @ ahead, rtol=0, atol=1e-13)


def test_torsion_keeps_the_tip_behind_the_base() -> None:
    plant = NeedlePlant(np.eye(4), curvature=0.0, torsion=Torsion(play=0.3))
    plant.advance(0.01, 0.5)
    assert float(plant.rotation) == pytest.approx(0.2)
    turned = Rotation.from_matrix(plant.T_rig_tip[:3, :3]).as_rotvec()
    np.testing.assert_allclose(turned, [0, 0, 0.2], atol=1e-13)


@pytest.mark.parametrize("inputs", [(np.nan, 0.0), (0.001, np.inf)])
def test_inputs_that_are_no_numbers_are_refused(inputs: tuple[float, float]) -> None:
    plant = NeedlePlant(np.eye(4), curvature=CURVATURE)
    with pytest.raises(ValueError, match="finite"):
        plant.advance(*inputs)
    np.testing.assert_array_equal(plant.T_rig_tip, np.eye(4))


def test_what_only_one_needle_can_do_is_refused_for_many() -> None:
    plant = NeedlePlant(np.tile(np.eye(4), (3, 1, 1)), curvature=CURVATURE)
    with pytest.raises(ValueError, match="no path to return"):
        plant.advance([0.0, -0.001, 0.0], 0.0)
    with pytest.raises(ValueError, match="single needle"):
        plant.centreline(0.001)


def test_bad_construction_and_spacing_are_refused() -> None:
    with pytest.raises(ValueError, match="shape"):
        NeedlePlant(np.eye(3), curvature=CURVATURE)
    with pytest.raises(ValueError, match="finite"):
        NeedlePlant(np.eye(4), curvature=np.nan)
    with pytest.raises(ValueError, match="spacing"):
        NeedlePlant(np.eye(4), curvature=CURVATURE).centreline(0.0)
