"""Refraction, compared with Snell's law and OpenCV's pinhole camera."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from needle_sim.camera.optics import project, refraction_point
from needle_sim.camera.stereo_rig import SimulatedWindow, StereoRig

HEIGHT = 0.0175


def surface(index: float) -> SimulatedWindow:
    return SimulatedWindow(np.array([1.0, 0.0, 0.0]), HEIGHT, (), (index,))


def points_inside(count: int) -> np.ndarray:
    low, high = [-0.0175, -0.03, 0.0], [HEIGHT - 0.001, 0.03, 0.13]
    return np.random.default_rng(1).uniform(low, high, (count, 3))


def test_projection_equals_opencv_without_refraction_and_on_or_above_the_surface(
    rig: StereoRig,
) -> None:
    inside = points_inside(50)
    on_it = np.column_stack([np.full(50, HEIGHT), inside[:, 1:]])
    for camera in (rig.left, rig.right):
        pose = camera.T_optical_rig
        dry = dataclasses.replace(camera, window=surface(1.0))
        for points, which in (
            (inside, dry),
            (on_it, camera),
            (inside + np.array([0.04, 0.0, 0.0]), camera),
        ):
            rotation = cv2.Rodrigues(pose[:3, :3])[0]
            expected, _ = cv2.projectPoints(
                points, rotation, pose[:3, 3].copy(), camera.camera_matrix, camera.distortion
            )
            seen = project(points, which)
            np.testing.assert_allclose(seen, expected.reshape(-1, 2), rtol=0, atol=1e-8)


def refracted(direction: np.ndarray, normal: np.ndarray, ratio: float) -> np.ndarray:
    """Snell's law for vectors, by angles: from a medium into one of another index."""
    cosine = -float(direction @ normal)
    angle = np.arcsin(np.sin(np.arccos(min(cosine, 1.0))) / ratio)
    along = direction + cosine * normal
    along = along / max(float(np.linalg.norm(along)), 1e-300)
    return np.asarray(np.sin(angle) * along - np.cos(angle) * normal)


@pytest.mark.parametrize("layers", [(), (0.005,), (0.005, 0.003, 0.01)])
def test_a_ray_traced_from_face_to_face_meets_the_point(layers: tuple[float, ...]) -> None:
    normal = np.array([0.1, 0.97, -0.2]) / np.linalg.norm([0.1, 0.97, -0.2])
    indices = (1.49, 1.1, 1.6)[: len(layers)]
    window = SimulatedWindow(normal, 0.03, layers, (*indices, 1.34))
    centre = np.array([0.02, 0.5, 0.1])
    points = np.random.default_rng(4).uniform([-0.2, -0.15, -0.1], [0.2, -0.08, 0.3], (50, 3))
    for point, crossing in zip(points, refraction_point(points, centre, window), strict=True):
        assert window.height(crossing) == pytest.approx(0.03, abs=1e-15)
        direction = (crossing - centre) / np.linalg.norm(crossing - centre)
        place, before = crossing, 1.0
        for thickness, index in zip(layers, indices, strict=True):
            direction = refracted(direction, normal, index / before)
            place = place + direction * thickness / -float(direction @ normal)
            before = index
        direction = refracted(direction, normal, 1.34 / before)
        np.testing.assert_allclose(np.cross(point - place, direction), 0.0, atol=1e-9)
