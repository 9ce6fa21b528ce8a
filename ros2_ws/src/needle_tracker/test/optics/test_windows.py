"""Refraction at windows of any position, direction and number of layers, against its laws.

Oracles: the package aquacal, Fermat's principle, Snell's law, OpenCV's projection.
"""

from __future__ import annotations

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
from needle_tracker.optics.refraction import RefractedCamera

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
def test_pixels_agree_with_aquacal(aquacal: Any, seed: int) -> None:
    # The world of aquacal has z down into the water: x = rig y, y = -rig z, z = -rig x.
    turn = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    view, points = random_view(seed, 0, np.eye(3))
    schema = importlib.import_module("aquacal.config.schema")
    camera, pose = view.camera, view.camera.T_optical_rig
    intrinsics = schema.CameraIntrinsics(camera.camera_matrix, camera.distortion, (1024, 768))
    extrinsics = schema.CameraExtrinsics(pose[:3, :3] @ turn.T, pose[:3, 3])
    surface = aquacal.Interface(
        normal=np.array([0.0, 0.0, -1.0]),
        camera_distances={"camera": -camera.window.point[0]},
        n_air=1.0,
        n_water=camera.window.inside,
    )
    other = aquacal.Camera("camera", intrinsics, extrinsics)
    pixels = [
        aquacal.refractive_project(other, surface, p, max_iterations=50, tolerance=1e-15)
        for p in points @ turn.T
    ]
    np.testing.assert_allclose(view.project(points), pixels, rtol=0.0, atol=1e-8)


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


def test_a_point_behind_the_camera_has_no_pixel() -> None:
    view, _ = random_view(0, 0)
    camera = view.camera
    assert np.all(np.isnan(view.project(2.0 * camera.centre - camera.window.point)))


def test_lens_and_slopes_agree_with_opencv_and_finite_differences(
    calibration: StereoCalibration, views: tuple[RefractedCamera, RefractedCamera]
) -> None:
    point, move = np.array([0.002, 0.01, 0.07]), np.array([1e-5, -2e-5, 1.5e-5])
    for view in views:
        moved = view.project(point + 0.5 * move) - view.project(point - 0.5 * move)
        np.testing.assert_allclose(view.jacobian(point) @ move, moved, atol=1e-7)
    camera = calibration.left
    above = point + 0.03 * camera.window.normal
    assert camera.window.height(above) > 0.0
    np.testing.assert_allclose(
        views[0].project(above), straight(camera, above[None])[0], rtol=0.0, atol=1e-9
    )
