"""The renderer: position and end of the needle, noise, repeatability."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from needle_sim.camera.optics import project
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import CLEAN
from needle_sim.camera.stereo_rig import StereoRig, load_stereo_rig
from needle_sim.camera.stroke import stroke
from needle_sim.needle.needle_shape import NeedleShape
from needle_sim.needle.plant import NeedlePlant, initial_pose

from .scenes import (
    CALIBRATION,
    CURVATURE,
    STILL,
    TOP_AND_SIDE,
    darkness,
    needle,
    render,
    small,
    taken,
)


def middles(dark: np.ndarray, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the centre of the dark pixels in each column, searched around some rows."""
    about = np.rint(rows).astype(int)[:, np.newaxis] + np.arange(-9, 10)
    part = dark[about, columns[:, np.newaxis]]
    return np.asarray((part * about).sum(axis=1) / part.sum(axis=1))


@pytest.mark.parametrize("calibration", [CALIBRATION, TOP_AND_SIDE], ids=["above", "windows"])
def test_the_shaft_is_darkest_where_its_path_projects(calibration: object) -> None:
    rig = load_stereo_rig(str(calibration))
    # The same path from geometry: a circle in the entry pose's y-z plane, towards -y.
    angle = np.linspace(0.01, 0.07, 400)[:, np.newaxis] * CURVATURE
    circle = np.hstack([0.0 * angle, np.cos(angle) - 1.0, np.sin(angle)]) / CURVATURE
    path = circle @ initial_pose(*np.deg2rad([2.0, 15.0]))[:3, :3].T
    dark = darkness(StereoRenderer(rig, seed=5), needle(0.11))
    for image, camera in zip(dark, (rig.left, rig.right), strict=True):
        u, v = project(path, camera).T
        columns = np.arange(np.ceil(u[0]), np.floor(u[-1])).astype(int)
        expected = np.interp(columns, u, v)
        error = middles(image, columns, expected) - expected
        assert np.abs(error).max() < 0.15
        assert abs(np.mean(error)) < 0.015


def test_noise_follows_the_scenario_and_differs_by_exposure_camera_and_seed(rig: StereoRig) -> None:
    rig = small(rig)
    for level in (3.0, 5.0):
        scenario = dataclasses.replace(CLEAN, noise=level)
        one, other = (StereoRenderer(rig, seed, scenario=scenario) for seed in (5, 6))
        first = render(one, None, 0)
        differences = taken(render(one, None, 1), first)
        for difference in differences:
            assert difference.std() / np.sqrt(2.0) == pytest.approx(level, abs=0.1)
            assert abs(difference.mean()) < 0.1
        assert abs(np.corrcoef(differences[0].ravel(), differences[1].ravel())[0, 1]) < 0.03
        assert taken(render(other, None, 0), first)[0].std() > level
    still = StereoRenderer(rig, 5, scenario=STILL)
    np.testing.assert_array_equal(render(still, None, 0), render(still, None, 1))


def test_any_insertion_can_be_rendered_and_a_needle_that_is_out_is_not_drawn(
    rig: StereoRig,
) -> None:
    renderer = StereoRenderer(small(rig), 5, scenario=STILL)
    nothing = render(renderer, None, 3)
    out = NeedlePlant(np.eye(4), curvature=CURVATURE)
    np.testing.assert_array_equal(render(renderer, out, 3), nothing)
    for length in (2e-6, 1e-4, 0.001):
        render(renderer, needle(length, 5.0, 170.0), 3)
    assert taken(render(renderer, needle(0.3, 5.0, 170.0), 3), nothing).max() > 20.0


def test_a_stroke_covers_its_area_about_its_middle() -> None:
    for angle in np.deg2rad([0.0, 7.0, 45.0, 123.0, 270.0]):
        direction = np.array([np.cos(angle), np.sin(angle)])
        line = np.array([50.3, 50.6]) + np.linspace(-20.0, 20.0, 21)[:, np.newaxis] * direction
        seen = stroke(line, np.full(21, 2.3), 0.7, (101, 101))
        image = np.zeros((101, 101))
        image[seen.row, seen.column] = seen.coverage
        assert image.sum() == pytest.approx(40.0 * 4.6, rel=1e-3)
        rows, columns = np.mgrid[:101, :101]
        assert (image * columns).sum() / image.sum() == pytest.approx(50.3, abs=2e-3)
        assert (image * rows).sum() / image.sum() == pytest.approx(50.6, abs=2e-3)
        assert image.max() <= 1.0


def test_the_bend_turns_by_its_angle_and_ends_at_the_tip() -> None:
    plant = NeedlePlant(initial_pose(0.1, 0.7), curvature=0.0)
    plant.advance(0.08, 0.4)
    pose = plant.T_rig_tip
    line = NeedleShape().shaft_centreline(pose, plant.centreline(0.001), 0.0001)
    np.testing.assert_array_equal(line[-1], pose[:3, 3])
    local = (line - pose[:3, 3]) @ pose[:3, :3]
    # Distal segment: 9 mm, straight, leaning towards -y.
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
