"""Refraction against Snell, Fermat and OpenCV's pinhole camera."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.optimize import minimize

from needle_sim.camera.projection import project, refraction_point
from needle_sim.camera.stereo_rig import SimulatedCamera, StereoRig, load_stereo_rig
from needle_sim.camera.window import SimulatedWindow

CALIBRATION = Path(__file__).parents[3] / "needle_tracker" / "config" / "calibration.yaml"
HEIGHT = 0.0175


@pytest.fixture(scope="module")
def rig() -> StereoRig:
    return load_stereo_rig(CALIBRATION)


def surface(index: float) -> SimulatedWindow:
    return SimulatedWindow(np.array([1.0, 0.0, 0.0]), HEIGHT, (), (index,))


def through(camera: SimulatedCamera, index: float) -> SimulatedCamera:
    return dataclasses.replace(camera, window=surface(index))


def points_inside(count: int, seed: int = 1) -> np.ndarray:
    low, high = [-0.0175, -0.03, 0.0], [HEIGHT - 0.001, 0.03, 0.13]
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


def opencv_pixels(points: np.ndarray, camera: SimulatedCamera) -> np.ndarray:
    pose = camera.T_optical_rig
    pixels, _ = cv2.projectPoints(
        points,
        cv2.Rodrigues(pose[:3, :3])[0],
        pose[:3, 3].copy(),
        camera.camera_matrix,
        camera.distortion,
    )
    return np.asarray(pixels).reshape(-1, 2)


def test_without_refraction_it_is_opencv_s_camera(rig: StereoRig) -> None:
    points = points_inside(200)
    for camera in (rig.left, rig.right):
        seen = project(points, through(camera, 1.0))
        np.testing.assert_allclose(seen, opencv_pixels(points, camera), rtol=0, atol=1e-8)


def test_above_the_surface_nothing_is_refracted(rig: StereoRig) -> None:
    points = points_inside(50) + np.array([0.04, 0.0, 0.0])
    seen = project(points, rig.left)
    np.testing.assert_allclose(seen, opencv_pixels(points, rig.left), rtol=0, atol=1e-8)


def test_on_the_surface_nothing_is_refracted(rig: StereoRig) -> None:
    points = points_inside(50)
    points[:, 0] = HEIGHT
    seen = project(points, rig.left)
    np.testing.assert_allclose(seen, opencv_pixels(points, rig.left), rtol=0, atol=1e-8)


@pytest.mark.parametrize("index", [1.0, 1.3, 1.8])
@pytest.mark.parametrize("spread", [0.03, 1.5])
def test_snell_s_law_holds_in_the_plane_of_incidence(
    rig: StereoRig, index: float, spread: float
) -> None:
    points = points_inside(300)
    points[:, 1:] *= spread / 0.03
    centre = rig.right.centre
    crossing = refraction_point(points, centre, surface(index))
    into, out = crossing - points, centre - crossing
    into /= np.linalg.norm(into, axis=1)[:, np.newaxis]
    out /= np.linalg.norm(out, axis=1)[:, np.newaxis]
    np.testing.assert_array_equal(crossing[:, 0], HEIGHT)
    # Both horizontal parts, as vectors: n sin(inside) = sin(outside).
    np.testing.assert_allclose(index * into[:, 1:], out[:, 1:], rtol=0, atol=1e-11)


def test_the_ray_takes_the_least_optical_path(rig: StereoRig) -> None:
    centre = rig.left.centre
    for point in points_inside(10, seed=2):

        def optical_path(place: np.ndarray, point: np.ndarray = point) -> float:
            crossing = np.array([HEIGHT, *(place * 1e-3)])
            inside = np.linalg.norm(crossing - point)
            return float(1.3 * inside + np.linalg.norm(centre - crossing))

        options = {"xatol": 1e-7, "fatol": 1e-17, "maxiter": 2000}
        found = minimize(optical_path, point[1:] * 1e3, method="Nelder-Mead", options=options)
        crossing = refraction_point(point, centre, surface(1.3))
        np.testing.assert_allclose(crossing[1:], found.x * 1e-3, rtol=0, atol=1e-7)


def test_a_point_below_the_camera_is_seen_straight_down(rig: StereoRig) -> None:
    centre = rig.left.centre
    crossing = refraction_point([0.0, centre[1], centre[2]], centre, surface(1.3))
    np.testing.assert_array_equal(crossing, [HEIGHT, centre[1], centre[2]])


def test_the_whole_way_of_the_needle_is_in_both_images(rig: StereoRig) -> None:
    grid = np.stack(
        np.meshgrid([-0.0175, 0.0, 0.0175], [-0.015, 0.0, 0.015], [0.0, 0.06, 0.13]), axis=-1
    )
    for camera in (rig.left, rig.right):
        seen = project(grid, camera)
        assert seen.shape == (3, 3, 3, 2)
        assert np.all((seen > 10.0) & (seen < [1014.0, 758.0]))


def refracted(direction: np.ndarray, normal: np.ndarray, ratio: float) -> np.ndarray:
    """Snell's law for vectors, by angles: from a medium into one of another index."""
    cosine = -float(direction @ normal)
    angle = np.arcsin(np.sin(np.arccos(min(cosine, 1.0))) / ratio)
    along = direction + cosine * normal
    length = np.linalg.norm(along)
    along = along / length if length > 0.0 else along
    return np.asarray(np.sin(angle) * along - np.cos(angle) * normal)


@pytest.mark.parametrize("layers", [(), (0.005,), (0.005, 0.003, 0.01)])
def test_a_ray_traced_from_face_to_face_meets_the_point(layers: tuple[float, ...]) -> None:
    normal = np.array([0.1, 0.97, -0.2]) / np.linalg.norm([0.1, 0.97, -0.2])
    indices = (1.49, 1.1, 1.6)[: len(layers)]
    window = SimulatedWindow(normal, 0.03, layers, (*indices, 1.34))
    centre = np.array([0.02, 0.5, 0.1])
    points = np.random.default_rng(4).uniform([-0.2, -0.15, -0.1], [0.2, -0.08, 0.3], (100, 3))
    for point, crossing in zip(points, refraction_point(points, centre, window), strict=True):
        assert window.height(crossing) == pytest.approx(0.03, abs=1e-15)
        direction = (crossing - centre) / np.linalg.norm(crossing - centre)
        place, before = crossing, 1.0
        for thickness, index in zip(layers, indices, strict=True):
            direction = refracted(direction, normal, index / before)
            place = place + direction * thickness / -float(direction @ normal)
            before = index
        direction = refracted(direction, normal, 1.34 / before)
        away = point - place
        np.testing.assert_allclose(np.cross(away, direction), 0.0, atol=1e-9)
