"""Refraction at windows of any position, direction and number of layers, against its laws.

Oracles: the package aquacal, Fermat's principle, Snell's law, OpenCV's projection.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import sys
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from needle_tracker.optics.calibration import (
    Camera,
    Layer,
    StereoCalibration,
    Window,
)
from needle_tracker.optics.refraction import (
    RefractedCamera,
    pixel_ray,
    project_optical,
    project_point,
)

Array = np.ndarray


def random_view(seed: int, layers: int, turn: Array | None = None) -> tuple[RefractedCamera, Array]:
    """Return a camera up to 40 deg oblique to a window of some layers, and points behind it."""
    rng = np.random.default_rng(seed)
    turn = Rotation.random(rng=rng).as_matrix() if turn is None else turn
    walls = tuple(Layer(*rng.uniform([1e-3, 1.0], [0.02, 1.8]).tolist()) for _ in range(layers))
    window = Window(rng.uniform(-0.1, 0.1, 3), turn[:, 0], walls, float(rng.uniform(1.2, 1.6)))
    distance, tilt = rng.uniform(0.1, 1.0), rng.uniform(0.0, 0.7)
    centre = window.point + distance * (np.cos(tilt) * turn[:, 0] + np.sin(tilt) * turn[:, 1])
    ahead = (window.point - centre) / distance
    right = np.cross(ahead, turn[:, 2])
    right /= np.linalg.norm(right)
    transform = np.eye(4)
    transform[:3, :3] = [right, np.cross(ahead, right), ahead]
    transform[:3, 3] = -transform[:3, :3] @ centre
    matrix = np.array([[3000.0, 0.0, 500.0], [0.0, 3100.0, 400.0], [0.0, 0.0, 1.0]])
    distortion = np.array([-0.1, 0.08, 3e-4, -2e-4, 0.0])
    camera = Camera(1024, 768, matrix, distortion, transform, window)
    low = [-window.thickness - 0.05, -0.1 * distance, -0.1 * distance]
    high = [-window.thickness - 1e-4, 0.1 * distance, 0.1 * distance]
    return RefractedCamera(camera), window.point + rng.uniform(low, high, (40, 3)) @ turn.T


VIEWS = pytest.mark.parametrize(("view", "points"), [random_view(n, n) for n in range(4)])


def straight(camera: Camera, points: Array) -> Array:
    """Return the pixels without any window, by OpenCV."""
    pose = camera.T_optical_rig
    turn, _ = cv2.Rodrigues(pose[:3, :3])
    pixels, _ = cv2.projectPoints(
        points, turn, pose[:3, 3], camera.camera_matrix, camera.distortion
    )
    return np.asarray(pixels.reshape(-1, 2))


def compiled_pixels(view: RefractedCamera, points: Array) -> Array:
    pixels = np.empty((len(points), 2))
    for point, pixel in zip(points, pixels, strict=True):
        project_point(view.packed, point, pixel)
    return pixels


def compiled_rays(view: RefractedCamera, pixels: Array) -> tuple[Array, Array]:
    origins, directions = np.empty((len(pixels), 3)), np.empty((len(pixels), 3))
    rows = np.ascontiguousarray(pixels)
    for pixel, origin, direction in zip(rows, origins, directions, strict=True):
        pixel_ray(view.packed, pixel, origin, direction)
    return origins, directions


@pytest.fixture(scope="module")
def aquacal() -> Any:
    """Geometry of aquacal alone: `import aquacal` would need all that its calibration needs."""
    spec = importlib.util.find_spec("aquacal")
    assert spec is not None, "aquacal is not installed: scripts/setup"
    assert spec.submodule_search_locations is not None
    package = ModuleType("aquacal")
    package.__path__ = list(spec.submodule_search_locations)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "aquacal", package)
        yield importlib.import_module("aquacal.core")
        for name in [name for name in sys.modules if name.startswith("aquacal.")]:
            patch.delitem(sys.modules, name)


@pytest.mark.parametrize("seed", range(3))
def test_pixels_and_rays_agree_with_aquacal(aquacal: Any, seed: int) -> None:
    # The world of aquacal has z down into the water: x = rig y, y = -rig z, z = -rig x.
    turn = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    view, points = random_view(seed, 0, np.eye(3))
    schema = importlib.import_module("aquacal.config.schema")
    # aquacal undistorts by few iterations of OpenCV, so rays are compared with a perfect lens.
    for distortion in (view.camera.distortion, np.zeros(5)):
        camera = dataclasses.replace(view.camera, distortion=distortion)
        view, pose = RefractedCamera(camera), camera.T_optical_rig
        intrinsics = schema.CameraIntrinsics(camera.camera_matrix, distortion, (1024, 768))
        extrinsics = schema.CameraExtrinsics(pose[:3, :3] @ turn.T, pose[:3, 3])
        surface = aquacal.Interface(
            normal=np.array([0.0, 0.0, -1.0]),
            camera_distances={"camera": -camera.window.point[0]},
            n_air=1.0,
            n_water=camera.window.inside,
        )
        other = aquacal.Camera("camera", intrinsics, extrinsics)
        pixels = np.array(
            [
                aquacal.refractive_project(other, surface, p, max_iterations=50, tolerance=1e-15)
                for p in points @ turn.T
            ]
        )
        np.testing.assert_allclose(view.project(points), pixels, rtol=0.0, atol=1e-8)
    rays = np.array([aquacal.refractive_back_project(other, surface, p) for p in pixels]) @ turn
    np.testing.assert_allclose(compiled_rays(view, pixels)[0], rays[:, 0], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(compiled_rays(view, pixels)[1], rays[:, 1], rtol=0.0, atol=1e-12)


@VIEWS
def test_light_takes_the_fastest_path_through_all_layers(
    view: RefractedCamera, points: Array
) -> None:
    """Fermat: the travel time is stationary with respect to the crossing of each face."""
    window = view.camera.window
    along = np.linalg.svd(window.normal[None])[2][1:]
    depths = np.cumsum([0.0, *(layer.thickness for layer in window.layers)])
    indices = [1.0, *(layer.refractive_index for layer in window.layers), window.inside]
    for point, pixel in zip(points[:10], view.project(points[:10]), strict=True):

        def crossings(places: Array) -> Array:
            faces = window.point - depths[:, None] * window.normal
            return np.asarray(faces + places.reshape(-1, 2) @ along)

        def slope(places: Array, point: Array = point) -> Array:
            way = np.stack([view.camera.centre, *crossings(places), point])
            parts = np.diff(way, axis=0)
            slowness = np.array(indices)[:, None] * parts / np.linalg.norm(parts, axis=1)[:, None]
            return np.asarray(((slowness[:-1] - slowness[1:]) @ along.T).ravel())

        above, below = window.height(view.camera.centre), window.height(point)
        share = ((above + depths) / (above - below))[:, None]
        line = view.camera.centre + share * (point - view.camera.centre)
        found = root(slope, ((line - window.point) @ along.T).ravel(), tol=1e-13)
        assert np.abs(found.fun).max() < 1e-9
        expected = straight(view.camera, crossings(found.x)[:1])[0]
        np.testing.assert_allclose(pixel, expected, rtol=0.0, atol=1e-5)


@VIEWS
def test_a_ray_leads_back_to_the_point_by_snells_law(view: RefractedCamera, points: Array) -> None:
    window = view.camera.window
    for lens in (view.camera.distortion, np.zeros(5)):
        camera = dataclasses.replace(view.camera, distortion=lens)
        view = RefractedCamera(camera)
        pixels = view.project(points)
        origins, directions = compiled_rays(view, pixels)
        np.testing.assert_allclose(window.depth(origins), 0.0, atol=1e-12)
        away = points - origins
        across = away - np.sum(away * directions, axis=1)[:, None] * directions
        np.testing.assert_allclose(across, 0.0, atol=1e-12)
    # The layers between the faces displace the ray, but do not turn it.
    matrix = np.linalg.inv(camera.camera_matrix)
    air = np.column_stack([pixels, np.ones(len(pixels))]) @ matrix.T
    air = air / np.linalg.norm(air, axis=1)[:, None] @ camera.T_optical_rig[:3, :3]
    bent = window.inside * np.cross(window.normal, directions)
    np.testing.assert_allclose(np.cross(window.normal, air), bent, atol=1e-12)
    assert np.all(directions @ window.normal < 0.0)


@VIEWS
def test_the_compiled_projection_agrees_with_the_array_projection(
    view: RefractedCamera, points: Array
) -> None:
    # Deep, in the layers, and in front of the window.
    window, depths = view.camera.window, np.linspace(-0.03, 0.05, len(points))
    everywhere = points + (window.depth(points) - depths)[:, None] * window.normal
    pixels = view.project(everywhere)
    np.testing.assert_allclose(compiled_pixels(view, everywhere), pixels, rtol=0.0, atol=1e-9)


def test_missing_rays_and_pixels_are_nan() -> None:
    view, _ = random_view(0, 0)
    camera = view.camera
    # Strong barrel distortion: no ideal point is imaged that far out.
    barrel = np.array([-0.5, 0.0, 0.0, 0.0, 0.0])
    far = camera.camera_matrix[:2, 2] + 3.0 * camera.camera_matrix[[0, 1], [0, 1]]
    bent = RefractedCamera(dataclasses.replace(camera, distortion=barrel))
    # A reversed camera looks away from the window.
    pose = camera.T_optical_rig.copy()
    pose[:3, :3] = np.diag([-1.0, 1.0, -1.0]) @ pose[:3, :3]
    pose[:3, 3] = -pose[:3, :3] @ camera.centre
    away = RefractedCamera(dataclasses.replace(camera, T_optical_rig=pose))
    for seen, pixel in (
        (view, np.array([np.nan, 100.0])),
        (bent, far),
        (away, camera.camera_matrix[:2, 2]),
    ):
        assert np.all(np.isnan(compiled_rays(seen, pixel[None])[1]))
    assert np.all(np.isnan(view.project(2.0 * camera.centre - camera.window.point)))


def test_lens_and_slopes_agree_with_opencv_and_finite_differences(
    calibration: StereoCalibration, views: tuple[RefractedCamera, RefractedCamera]
) -> None:
    point, move = np.array([0.002, 0.01, 0.07]), np.array([1e-5, -2e-5, 1.5e-5])
    for view in views:
        moved = view.project(point + 0.5 * move) - view.project(point - 0.5 * move)
        np.testing.assert_allclose(view.jacobian(point) @ move, moved, atol=1e-7)
    pose = calibration.left.T_optical_rig
    seen = project_optical(calibration.left, pose[:3, :3] @ point + pose[:3, 3])
    np.testing.assert_allclose(seen, straight(calibration.left, point[None])[0], atol=1e-9)
