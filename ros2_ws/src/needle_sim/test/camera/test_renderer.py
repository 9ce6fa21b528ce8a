"""The renderer: where the needle's darkness lies, its end, its noise, its repeatability."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from needle_core.errors import UserError
from needle_sim.camera.projection import project
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import SCENARIOS
from needle_sim.camera.stereo_rig import StereoRig, load_stereo_rig
from needle_sim.camera.stroke import stroke
from needle_sim.needle.needle_shape import NeedleShape
from needle_sim.needle.plant import NeedlePlant, initial_pose

CALIBRATION = Path(__file__).parents[3] / "needle_tracker" / "config" / "calibration.yaml"
CURVATURE = 1.0 / 0.122
NO_NEEDLE = np.zeros((1, 3))


@pytest.fixture(scope="module")
def rig() -> StereoRig:
    return load_stereo_rig(CALIBRATION)


@pytest.fixture(scope="module")
def renderer(rig: StereoRig) -> StereoRenderer:
    return StereoRenderer(rig, seed=5)


def needle(pitch_deg: float, roll_deg: float, length: float) -> NeedlePlant:
    plant = NeedlePlant(initial_pose(*np.deg2rad([pitch_deg, roll_deg])), curvature=CURVATURE)
    plant.advance(length, 0.0)
    return plant


def darkness(renderer: StereoRenderer, plant: NeedlePlant) -> np.ndarray:
    """What the needle takes from each image; exposures of equal number share their noise."""
    sums = np.zeros((2, 768, 1024))
    for number in range(6):
        empty = renderer.render(np.eye(4), NO_NEEDLE, number)
        drawn = renderer.render(plant.T_rig_tip, plant.centreline(0.001), number)
        sums += np.stack(empty).astype(float) - np.stack(drawn)
    return sums / 6.0


def test_the_shaft_is_darkest_where_its_path_projects(
    rig: StereoRig, renderer: StereoRenderer
) -> None:
    plant = needle(2.0, 15.0, 0.11)
    # The path once more, from geometry: a circle in the entry pose's y-z plane, towards -y.
    angle = np.linspace(0.01, 0.07, 400) * CURVATURE
    circle = np.zeros((400, 3))
    circle[:, 1] = (np.cos(angle) - 1.0) / CURVATURE
    circle[:, 2] = np.sin(angle) / CURVATURE
    path = circle @ initial_pose(*np.deg2rad([2.0, 15.0]))[:3, :3].T
    for camera, dark in zip((rig.left, rig.right), darkness(renderer, plant), strict=True):
        u, v = project(path, camera).T
        columns = np.arange(np.ceil(u[0]), np.floor(u[-1])).astype(int)
        expected = np.interp(columns, u, v)
        error = []
        for column, row in zip(columns, expected, strict=True):
            rows = int(row) + np.arange(-8, 10)
            part = dark[rows, column]
            error.append(float(rows @ part / part.sum() - row))
        assert np.abs(error).max() < 0.1
        assert abs(np.mean(error)) < 0.01


@pytest.mark.parametrize("length", [0.04, 0.0803, 0.12])
def test_the_needle_ends_at_the_tip(
    rig: StereoRig, renderer: StereoRenderer, length: float
) -> None:
    # Roll 90 deg: the needle bends in depth, so that it runs along u to within a few degrees.
    plant = needle(-20.0, 90.0, length)
    for camera, dark in zip((rig.left, rig.right), darkness(renderer, plant), strict=True):
        tip = plant.T_rig_tip[:3, 3]
        u, v = project(tip, camera)
        across = round(float(v)) + np.arange(-12, 13)
        profile = dark[across].sum(axis=0)
        column = round(float(u))
        full = profile[column - 12 : column - 4].mean()
        end = column - 4.5 + profile[column - 4 : column + 8].sum() / full
        assert end == pytest.approx(float(u), abs=0.05)
        beyond = profile[column + 4 : column + 12]
        assert np.abs(beyond).max() < 0.01 * full
        # The middle line of the last 2 mm, prolonged to the end.
        columns = column - np.arange(5, 18)
        part = dark[across][:, columns]
        middle = across @ part / part.sum(axis=0)
        at_end = np.polyval(np.polyfit(columns - float(u), middle, 1), 0.0)
        assert at_end == pytest.approx(float(v), abs=0.1)


def test_equal_seeds_and_exposures_give_equal_images(
    rig: StereoRig, renderer: StereoRenderer
) -> None:
    plant = needle(2.0, 15.0, 0.05)
    once = renderer.render(plant.T_rig_tip, plant.centreline(0.001), 7)
    renderer.render(np.eye(4), NO_NEEDLE, 8)
    again = StereoRenderer(rig, seed=5).render(plant.T_rig_tip, plant.centreline(0.001), 7)
    for first, second in zip(once, again, strict=True):
        assert first.dtype == np.uint8
        assert first.shape == (768, 1024)
        np.testing.assert_array_equal(first, second)


def test_noise_is_new_in_every_exposure_camera_and_seed(
    rig: StereoRig, renderer: StereoRenderer
) -> None:
    left, right = (i.astype(float) for i in renderer.render(np.eye(4), NO_NEEDLE, 0))
    left_1, right_1 = (i.astype(float) for i in renderer.render(np.eye(4), NO_NEEDLE, 1))
    differences = [left - left_1, right - right_1]
    for difference in differences:
        assert difference.std() / np.sqrt(2.0) == pytest.approx(3.0, abs=0.1)
        assert abs(difference.mean()) < 0.02
    assert abs(np.corrcoef(differences[0].ravel(), differences[1].ravel())[0, 1]) < 0.01
    other = StereoRenderer(rig, seed=6).render(np.eye(4), NO_NEEDLE, 0)[0]
    assert (other - left).std() > 3.0


def test_a_needle_that_is_out_is_not_drawn(renderer: StereoRenderer) -> None:
    plant = NeedlePlant(np.eye(4), curvature=CURVATURE)
    out = renderer.render(plant.T_rig_tip, plant.centreline(0.001), 3)
    nothing = renderer.render(np.eye(4), NO_NEEDLE, 3)
    np.testing.assert_array_equal(out, nothing)


@pytest.mark.parametrize("angle_deg", [0.0, 7.0, 45.0, 123.0, 270.0])
def test_a_stroke_covers_its_area_about_its_middle(angle_deg: float) -> None:
    direction = np.array([np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))])
    line = np.array([50.3, 50.6]) + np.linspace(-20.0, 20.0, 21)[:, np.newaxis] * direction
    seen = stroke(line, np.full(21, 2.3), 0.7, (101, 101))
    image = np.zeros((101, 101))
    image[seen.row, seen.column] = seen.coverage
    assert image.sum() == pytest.approx(40.0 * 4.6, rel=1e-3)
    rows, columns = np.mgrid[:101, :101]
    assert (image * columns).sum() / image.sum() == pytest.approx(50.3, abs=2e-3)
    assert (image * rows).sum() / image.sum() == pytest.approx(50.6, abs=2e-3)
    assert image.max() <= 1.0


def test_a_stroke_beyond_the_image_is_cut() -> None:
    line = np.stack([np.linspace(-30.0, 30.0, 31), np.full(31, 1.0)], axis=-1)
    seen = stroke(line, np.full(31, 2.0), 0.7, (20, 10))
    assert seen.row.size > 0
    assert seen.row.min() >= 0
    assert seen.column.max() == 19


def test_the_bend_turns_by_its_angle_and_ends_at_the_tip() -> None:
    plant = NeedlePlant(initial_pose(0.1, 0.7), curvature=0.0)
    plant.advance(0.08, 0.4)
    pose = plant.T_rig_tip
    line = NeedleShape().middle_line(pose, plant.centreline(0.001), 0.0001)
    np.testing.assert_array_equal(line[-1], pose[:3, 3])
    local = (line - pose[:3, 3]) @ pose[:3, :3]
    # Distal segment: leaning towards -y, straight, 9 mm.
    direction = local[-1] - local[-50]
    direction /= np.linalg.norm(direction)
    lean = np.deg2rad(5.6)
    np.testing.assert_allclose(direction, [0.0, -np.sin(lean), np.cos(lean)], atol=1e-9)
    bend = int(np.argmax(local[:, 1]))
    assert local[bend, 2] == pytest.approx(-0.009, abs=1e-4)
    assert local[bend, 1] == pytest.approx(0.00088, abs=1e-5)
    before = local[bend - 2] - local[bend - 4]
    before /= np.linalg.norm(before)
    assert np.rad2deg(np.arccos(before @ direction)) == pytest.approx(10.0, abs=0.1)
    np.testing.assert_allclose(local[local[:, 2] < -0.032, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(local[:, 0], 0.0, atol=1e-12)


def test_a_needle_may_be_straight_but_not_lean_farther_than_it_bends() -> None:
    straight = NeedleShape(bend_angle=0.0, lean=0.0)
    np.testing.assert_array_equal(straight.sideways(np.linspace(0.0, 0.1, 50)), 0.0)
    for bend, lean in ((0.1, 0.1), (0.1, 0.0), (0.1, -0.05), (0.0, 0.05)):
        with pytest.raises(UserError, match=r"lean = \S+ rad, wants above 0 and less than"):
            NeedleShape(bend_angle=bend, lean=lean)


def test_a_thicker_needle_covers_more(rig: StereoRig) -> None:
    plant = NeedlePlant(np.eye(4), curvature=CURVATURE)
    plant.advance(0.06, 0.0)
    dark = []
    for diameter in (0.0005, 0.001, 0.002):
        renderer = StereoRenderer(rig, 1, NeedleShape(diameter))
        image, _ = renderer.render(plant.T_rig_tip, plant.centreline(0.001), 1)
        out, _ = renderer.render(np.eye(4), np.zeros((1, 3)), 1)
        dark.append(float(np.sum(np.asarray(out, dtype=float) - image)))
    assert dark[1] == pytest.approx(2.0 * dark[0], rel=0.1)
    assert dark[2] == pytest.approx(2.0 * dark[1], rel=0.1)


def test_a_short_path_draws_only_what_is_inside() -> None:
    plant = NeedlePlant(np.eye(4), curvature=CURVATURE)
    plant.advance(0.004, 0.0)
    line = NeedleShape().middle_line(plant.T_rig_tip, plant.centreline(0.001), 0.0003)
    assert line[0, 2] == pytest.approx(0.0, abs=5e-5)  # as far as the bend lies beside the path
    for length in (0.0, 1e-16, 1e-9):
        point = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, length]])
        assert NeedleShape().middle_line(np.eye(4), point, 0.0003).shape == (0, 3)


@pytest.mark.parametrize("length", [2e-6, 1e-4, 0.001, 0.3])
def test_any_insertion_can_be_rendered(renderer: StereoRenderer, length: float) -> None:
    plant = needle(5.0, 170.0, length)
    for image in renderer.render(plant.T_rig_tip, plant.centreline(0.001), 0):
        assert image.shape == (768, 1024)


def test_through_windows_the_needle_is_seen_from_above_and_from_aside() -> None:
    rig = load_stereo_rig(CALIBRATION.with_name("calibration_top_and_side.yaml"))
    plant = needle(2.0, 15.0, 0.11)
    path = plant.centreline(0.001)[10:70]
    for camera, dark in zip(
        (rig.left, rig.right), darkness(StereoRenderer(rig, seed=5), plant), strict=True
    ):
        u, v = project(path, camera).T
        for column in range(round(u[0]) + 1, round(u[-1]) - 1, 10):
            expected = float(np.interp(column, u, v))
            rows = round(expected) + np.arange(-9, 10)
            part = dark[rows, column]
            assert rows @ part / part.sum() == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_draws_through_windows(name: str) -> None:
    rig = load_stereo_rig(CALIBRATION.with_name("calibration_top_and_side.yaml"))
    renderer = StereoRenderer(rig, 5, scenario=SCENARIOS[name])
    plant = needle(2.0, 15.0, 0.08)
    for number in (1, 31):
        for image in renderer.render(plant.T_rig_tip, plant.centreline(0.001), number):
            assert image.shape == (768, 1024)
    if renderer.bubbles is not None:
        for camera in (rig.left, rig.right):
            heights = camera.window.height(renderer.bubbles.centre)
            assert np.all(heights + renderer.bubbles.radius < camera.window.inner)
