"""The camera and the surface, against OpenCV and Snell's law."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from needle_tracker.optics.calibration import Camera, StereoCalibration
from needle_tracker.optics.camera_model import distort, optical_rays, project_optical, undistort
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.optics.window import surface_from_above

Views = tuple[RefractedCamera, RefractedCamera]


def dry(camera: Camera) -> RefractedCamera:
    """Return a camera whose window refracts nothing."""
    window = surface_from_above(float(camera.window.point[0]), 1.0)
    return RefractedCamera(dataclasses.replace(camera, window=window))


@pytest.fixture
def points(calibration: StereoCalibration) -> np.ndarray:
    rng = np.random.default_rng(0)
    top = calibration.left.window.point[0]
    return rng.uniform([-top, -0.05, 0.0], [top - 1e-4, 0.05, 0.12], (500, 3))


def test_distortion_has_an_inverse_to_rounding(calibration: StereoCalibration) -> None:
    ideal = np.random.default_rng(0).uniform(-0.2, 0.2, (1000, 2))
    distortion = calibration.left.distortion
    np.testing.assert_allclose(undistort(distort(ideal, distortion), distortion), ideal, atol=1e-15)


def test_a_pixel_without_an_inverse_is_nan() -> None:
    # Strong barrel distortion: no ideal point is seen that far out.
    assert np.all(np.isnan(undistort(np.array([[3.0, 3.0]]), np.array([-0.5, 0, 0, 0, 0.0]))))


def test_projection_agrees_with_opencv(calibration: StereoCalibration, points: np.ndarray) -> None:
    camera = calibration.left
    pose = camera.T_optical_rig
    rotation, _ = cv2.Rodrigues(pose[:3, :3])
    expected, _ = cv2.projectPoints(
        points, rotation, pose[:3, 3], camera.camera_matrix, camera.distortion
    )
    own = project_optical(camera, points @ pose[:3, :3].T + pose[:3, 3])
    np.testing.assert_allclose(own, expected.reshape(-1, 2), atol=1e-9)
    # An index of 1 is no surface at all.
    air = dry(calibration.left)
    np.testing.assert_allclose(air.project(points), expected.reshape(-1, 2), atol=1e-8)


def test_points_above_the_surface_are_seen_straight(
    calibration: StereoCalibration, views: Views
) -> None:
    above = np.array([[calibration.left.window.point[0] + 0.01, 0.01, 0.05]])
    air = dry(calibration.left)
    np.testing.assert_allclose(views[0].project(above), air.project(above), atol=1e-9)


def test_points_behind_the_camera_are_not_seen(views: Views) -> None:
    assert np.all(np.isnan(views[0].project(np.array([5.0, 0.0, 0.05]))))


def test_rays_obey_snells_law(calibration: StereoCalibration, views: Views) -> None:
    pixels = np.random.default_rng(1).uniform([0, 0], [1023, 767], (300, 2))
    normal = np.array([1.0, 0.0, 0.0])
    view = views[1]
    origins, body = view.rays(pixels)
    air = optical_rays(view.camera, pixels) @ view.camera.T_optical_rig[:3, :3]
    np.testing.assert_allclose(origins[:, 0], calibration.left.window.point[0], atol=1e-15)
    np.testing.assert_allclose(
        np.cross(normal, air),
        calibration.left.window.inside * np.cross(normal, body),
        atol=1e-14,
    )
    assert np.all(body[:, 0] < 0.0)


def test_ignoring_refraction_costs_millimetres(
    calibration: StereoCalibration, points: np.ndarray
) -> None:
    wet = RefractedCamera(calibration.left)
    deep = points[points[:, 0] < -0.01]
    assert (
        np.linalg.norm(wet.project(deep) - dry(calibration.left).project(deep), axis=-1).max() > 1.0
    )


def test_a_point_straight_below_the_camera_is_seen_straight(
    calibration: StereoCalibration, views: Views
) -> None:
    below = views[0].camera.centre * [0.0, 1.0, 1.0]
    straight = dry(calibration.left).project(below)
    np.testing.assert_allclose(views[0].project(below), straight, atol=1e-9)


def test_jacobian_predicts_small_moves(views: Views) -> None:
    point, move = np.array([0.002, 0.01, 0.07]), np.array([1e-5, -2e-5, 1.5e-5])
    for view in views:
        moved = view.project(point + 0.5 * move) - view.project(point - 0.5 * move)
        np.testing.assert_allclose(view.jacobian(point) @ move, moved, atol=1e-7)
