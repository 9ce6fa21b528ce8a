"""Refraction on many rigs, against the package aquacal and against Fermat's principle."""

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

from needle_tracker.optics.calibration import Camera, StereoCalibration
from needle_tracker.optics.compiled_projection import pixel_ray, project_point
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.optics.window import surface_from_above

# aquacal's world has z down into the water: x = rig y, y = -rig z, z = -rig x.
R_AQUACAL_RIG = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
CAMERA = "camera"


@dataclasses.dataclass(frozen=True)
class Rig:
    """One camera over one phantom, and points in it."""

    view: RefractedCamera
    points: np.ndarray


def bench_rig(calibration: StereoCalibration, side: str) -> Rig:
    camera = calibration.left if side == "left" else calibration.right
    top = camera.window.point[0]
    points = np.random.default_rng(0).uniform(
        [-top, -0.05, 0.0], [top - 1e-4, 0.05, 0.12], (200, 3)
    )
    return Rig(RefractedCamera(camera), points)


def random_rig(seed: int) -> Rig:
    """Return a rig of another kind: up to 45 deg oblique, index 1.05 to 1.6, 0.1 to 1.5 m away."""
    rng = np.random.default_rng(seed)
    window = surface_from_above(float(rng.uniform(-0.1, 0.1)), float(rng.uniform(1.05, 1.6)))
    distance, tilt, round_about = rng.uniform([0.1, 0.0, 0.0], [1.5, 0.8, 2.0 * np.pi])
    target = np.array([window.point[0], *rng.uniform(-0.1, 0.1, 2)])
    side = np.array([0.0, np.cos(round_about), np.sin(round_about)])
    centre = target + distance * (np.cos(tilt) * np.array([1.0, 0.0, 0.0]) + np.sin(tilt) * side)
    ahead = (target - centre) / distance
    right = np.cross(ahead, rng.normal(size=3))
    right /= np.linalg.norm(right)
    transform = np.eye(4)
    transform[:3, :3] = [right, np.cross(ahead, right), ahead]
    transform[:3, 3] = -transform[:3, :3] @ centre
    fx, fy, cx, cy = rng.uniform([800.0, 800.0, 400.0, 300.0], [6000.0, 6000.0, 600.0, 450.0])
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    distortion = rng.uniform(-1.0, 1.0, 5) * [0.15, 0.1, 5e-4, 5e-4, 0.05]
    reach = 0.1 * distance
    top = target + np.array([-1e-6, reach, reach])
    points = rng.uniform(target - reach, top, (200, 3))
    return Rig(RefractedCamera(Camera(1024, 768, matrix, distortion, transform, window)), points)


@pytest.fixture(params=["left", "right", *range(12)], ids=str)
def rig(request: pytest.FixtureRequest, calibration: StereoCalibration) -> Rig:
    kind = request.param
    return bench_rig(calibration, kind) if isinstance(kind, str) else random_rig(kind)


@pytest.fixture(scope="module")
def aquacal() -> Any:
    """aquacal's geometry alone: `import aquacal` would want all that its calibration needs."""
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


def aquacal_rig(aquacal: Any, rig: Rig) -> tuple[Any, Any]:
    """Return aquacal's camera and surface for a rig of ours."""
    schema = importlib.import_module("aquacal.config.schema")
    camera, window = rig.view.camera, rig.view.camera.window
    pose = camera.T_optical_rig
    intrinsics = schema.CameraIntrinsics(
        camera.camera_matrix, camera.distortion, (camera.width, camera.height)
    )
    extrinsics = schema.CameraExtrinsics(pose[:3, :3] @ R_AQUACAL_RIG.T, pose[:3, 3])
    surface = aquacal.Interface(
        normal=np.array([0.0, 0.0, -1.0]),
        camera_distances={CAMERA: -window.point[0]},
        n_air=1.0,
        n_water=window.inside,
    )
    return aquacal.Camera(CAMERA, intrinsics, extrinsics), surface


def compiled_pixels(rig: Rig) -> np.ndarray:
    pixels = np.empty((len(rig.points), 2))
    for point, pixel in zip(rig.points, pixels, strict=True):
        project_point(rig.view.packed, point, pixel)
    return pixels


def compiled_rays(rig: Rig, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    origins, directions = np.empty((len(pixels), 3)), np.empty((len(pixels), 3))
    rows = np.ascontiguousarray(pixels)
    for pixel, origin, direction in zip(rows, origins, directions, strict=True):
        pixel_ray(rig.view.packed, pixel, origin, direction)
    return origins, directions


def test_pixels_are_those_of_aquacal(aquacal: Any, rig: Rig) -> None:
    camera, surface = aquacal_rig(aquacal, rig)
    expected = np.array(
        [
            aquacal.refractive_project(camera, surface, point, max_iterations=50, tolerance=1e-15)
            for point in rig.points @ R_AQUACAL_RIG.T
        ]
    )
    np.testing.assert_allclose(rig.view.project(rig.points), expected, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(compiled_pixels(rig), expected, rtol=0.0, atol=1e-8)


def test_rays_are_those_of_aquacal(aquacal: Any, rig: Rig) -> None:
    # Its lenses are undistorted by OpenCV's few iterations, hence a perfect lens here.
    plain = dataclasses.replace(rig.view.camera, distortion=np.zeros(5))
    rig = Rig(RefractedCamera(plain), rig.points)
    camera, surface = aquacal_rig(aquacal, rig)
    pixels = rig.view.project(rig.points)
    expected = np.array([aquacal.refractive_back_project(camera, surface, p) for p in pixels])
    for origins, directions in (rig.view.rays(pixels), compiled_rays(rig, pixels)):
        np.testing.assert_allclose(origins, expected[:, 0] @ R_AQUACAL_RIG, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(directions, expected[:, 1] @ R_AQUACAL_RIG, rtol=0.0, atol=1e-12)


def test_light_takes_the_fastest_of_all_paths(rig: Rig) -> None:
    """Fermat: the optical path is stationary in both directions along the surface."""
    camera, window = rig.view.camera, rig.view.camera.window
    pose = camera.T_optical_rig
    for point, pixel in zip(rig.points[:40], rig.view.project(rig.points[:40]), strict=True):

        def slope(place: np.ndarray, point: np.ndarray = point) -> np.ndarray:
            crossing = np.array([window.point[0], *place])
            air, body = crossing - camera.centre, crossing - point
            path = air / np.linalg.norm(air) + window.inside * (body / np.linalg.norm(body))
            return np.asarray(path[1:])

        # In units of the depth: just below the surface the crossing is right above the point.
        depth = window.point[0] - point[0]
        found = root(lambda x, p=point, d=depth: slope(p[1:] + d * x), np.zeros(2), tol=1e-14)
        assert np.linalg.norm(found.fun) < 1e-12
        crossing = np.array([window.point[0], *(point[1:] + depth * found.x)])
        rotation, _ = cv2.Rodrigues(pose[:3, :3])
        expected, _ = cv2.projectPoints(
            crossing[None], rotation, pose[:3, 3], camera.camera_matrix, camera.distortion
        )
        np.testing.assert_allclose(pixel, expected.reshape(2), rtol=0.0, atol=1e-6)


def test_what_is_projected_is_found_again(rig: Rig) -> None:
    """There and back within 1e-9 mm: the ray of a point's pixel passes through the point."""
    pixels = rig.view.project(rig.points)
    for origins, directions in (rig.view.rays(pixels), compiled_rays(rig, pixels)):
        offset = rig.points - origins
        along = np.sum(offset * directions, axis=-1, keepdims=True)
        assert np.linalg.norm(offset - along * directions, axis=-1).max() <= 1e-12
        assert along.min() > 0.0


def test_what_has_no_ray_has_none_compiled_either(rig: Rig) -> None:
    pixel = np.array([np.nan, 100.0])
    origins, directions = compiled_rays(rig, pixel[None])
    assert np.all(np.isnan(origins))
    assert np.all(np.isnan(directions))
    # Strong barrel distortion: no ideal point is seen that far out.
    barrel = dataclasses.replace(rig.view.camera, distortion=np.array([-0.5, 0.0, 0.0, 0.0, 0.0]))
    matrix = barrel.camera_matrix
    far = np.array([[matrix[0, 2] + 3.0 * matrix[0, 0], matrix[1, 2] + 3.0 * matrix[1, 1]]])
    view = RefractedCamera(barrel)
    assert np.all(np.isnan(compiled_rays(Rig(view, rig.points), far)[1]))
    assert np.all(np.isnan(view.rays(far)[1]))
    # A camera turned round looks up, away from the surface.
    flip = np.diag([-1.0, 1.0, -1.0])
    pose = rig.view.camera.T_optical_rig.copy()
    centre = rig.view.camera.centre
    pose[:3, :3] = flip @ pose[:3, :3]
    pose[:3, 3] = -pose[:3, :3] @ centre
    up = RefractedCamera(dataclasses.replace(rig.view.camera, T_optical_rig=pose))
    middle = up.camera.camera_matrix[:2, 2][None]
    assert np.all(np.isnan(compiled_rays(Rig(up, rig.points), middle)[1]))
    assert np.isnan(up.rays(middle)[1][0, 0])
