"""Windows of any place, direction and number of layers: Fermat, Snell, and what stays the same."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from needle_tracker.image.corridor import within_corridor
from needle_tracker.image.search_grid import Reach, make_search_grid
from needle_tracker.optics.calibration import Camera, StereoCalibration, load_calibration
from needle_tracker.optics.camera_model import optical_rays, project_optical
from needle_tracker.optics.compiled_projection import pixel_ray, project_point
from needle_tracker.optics.refraction import RefractedCamera, stereo_views
from needle_tracker.optics.window import Layer, Window, surface_from_above

ACRYLIC = Layer(5e-3, 1.49)
REACH = Reach(curvature=9.0, entry_angle=0.17, hole_tolerance=0.5e-3, length=0.15)


@pytest.fixture(scope="module")
def top_and_side(calibration_path: Path) -> StereoCalibration:
    return load_calibration(calibration_path.with_name("calibration_top_and_side.yaml"))


def random_view(seed: int) -> tuple[RefractedCamera, np.ndarray]:
    """A camera up to 40 deg oblique to a window of 0 to 3 layers, and points in its body."""
    rng = np.random.default_rng(seed)
    turn = Rotation.random(rng=rng).as_matrix()
    layers = tuple(
        Layer(float(t), float(n))
        for t, n in zip(rng.uniform(1e-3, 0.02, 3), rng.uniform(1.0, 1.8, 3), strict=True)
    )[: seed % 4]
    window = Window(rng.uniform(-0.1, 0.1, 3), turn[:, 0], layers, float(rng.uniform(1.2, 1.6)))
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
    return RefractedCamera(camera), window.point + rng.uniform(low, high, (60, 3)) @ turn.T


def straight(camera: Camera, points: np.ndarray) -> np.ndarray:
    pose = camera.T_optical_rig
    return project_optical(camera, points @ pose[:3, :3].T + pose[:3, 3])


def compiled_pixels(view: RefractedCamera, points: np.ndarray) -> np.ndarray:
    pixels = np.empty((len(points), 2))
    for point, pixel in zip(points, pixels, strict=True):
        project_point(view.packed, point, pixel)
    return pixels


@pytest.mark.parametrize("seed", range(8))
def test_light_takes_the_fastest_path_through_all_layers(seed: int) -> None:
    """Fermat: the travel time is stationary over where each face is crossed."""
    view, points = random_view(seed)
    window = view.camera.window
    along = np.linalg.svd(window.normal[None])[2][1:]
    depths = np.cumsum([0.0, *(layer.thickness for layer in window.layers)])
    indices = [1.0, *(layer.refractive_index for layer in window.layers), window.inside]
    for point, pixel in zip(points[:15], view.project(points[:15]), strict=True):

        def crossings(places: np.ndarray) -> np.ndarray:
            faces = window.point - depths[:, None] * window.normal
            return np.asarray(faces + places.reshape(-1, 2) @ along)

        def slope(places: np.ndarray, point: np.ndarray = point) -> np.ndarray:
            way = np.stack([view.camera.centre, *crossings(places), point])
            parts = np.diff(way, axis=0)
            slowness = np.array(indices)[:, None] * parts / np.linalg.norm(parts, axis=1)[:, None]
            return np.asarray(((slowness[:-1] - slowness[1:]) @ along.T).ravel())

        above, below = window.height(view.camera.centre), window.height(point)
        share = ((above + depths) / (above - below))[:, None]
        line = view.camera.centre + share * (point - view.camera.centre)
        start = ((line - window.point) @ along.T).ravel()
        found = root(slope, start, tol=1e-13)
        assert np.abs(found.fun).max() < 1e-9
        expected = straight(view.camera, crossings(found.x)[:1])[0]
        np.testing.assert_allclose(pixel, expected, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("seed", range(8))
def test_a_ray_leads_back_to_the_point_by_snells_law(seed: int) -> None:
    view, points = random_view(seed)
    window = view.camera.window
    pixels = view.project(points)
    origins, directions = view.rays(pixels)
    np.testing.assert_allclose(window.depth(origins), 0.0, atol=1e-12)
    away = points - origins
    across = away - np.sum(away * directions, axis=1)[:, None] * directions
    np.testing.assert_allclose(across, 0.0, atol=1e-12)
    # What lies between the faces changes the place, not the direction.
    air = optical_rays(view.camera, pixels) @ view.camera.T_optical_rig[:3, :3]
    np.testing.assert_allclose(
        np.cross(window.normal, air),
        window.inside * np.cross(window.normal, directions),
        atol=1e-12,
    )
    assert np.all(directions @ window.normal < 0.0)


@pytest.mark.parametrize("seed", range(8))
def test_the_compiled_model_is_the_same(seed: int) -> None:
    view, points = random_view(seed)
    # Deep, in the layers, and before the window.
    depths = np.linspace(-0.03, 0.05, len(points))
    everywhere = points + (view.camera.window.depth(points) - depths)[:, None] * (
        view.camera.window.normal
    )
    pixels = view.project(everywhere)
    np.testing.assert_allclose(compiled_pixels(view, everywhere), pixels, rtol=0.0, atol=1e-9)
    for pixel, origin, direction in zip(pixels, *view.rays(pixels), strict=True):
        one, other = np.empty(3), np.empty(3)
        pixel_ray(view.packed, pixel, one, other)
        np.testing.assert_allclose(one, origin, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(other, direction, rtol=0.0, atol=1e-12)


def test_a_point_before_the_window_is_seen_straight() -> None:
    view, points = random_view(3)
    window = view.camera.window
    before = points + (1e-6 - window.height(points))[:, None] * window.normal
    np.testing.assert_allclose(view.project(before), straight(view.camera, before), atol=1e-9)


def test_what_is_seen_does_not_jump_at_a_face() -> None:
    view, points = random_view(7)
    window = view.camera.window
    for depth in np.cumsum([0.0, *(layer.thickness for layer in window.layers)]):
        outside, inside = (
            view.project(points - (window.height(points) + depth + step)[:, None] * window.normal)
            for step in (-1e-9, 1e-9)
        )
        np.testing.assert_allclose(outside, inside, atol=1e-4)


def with_window(view: RefractedCamera, **changes: object) -> RefractedCamera:
    window = dataclasses.replace(view.camera.window, **changes)  # type: ignore[arg-type]
    return RefractedCamera(dataclasses.replace(view.camera, window=window))


def test_layers_are_what_they_are_made_of() -> None:
    view, points = random_view(0)
    window = view.camera.window
    deep = points - 0.01 * window.normal
    # Of the body's own index: no layer at all. Two of one index: one. Of air: the body is lower.
    of_body = with_window(view, layers=(Layer(5e-3, window.inside),))
    np.testing.assert_allclose(of_body.project(deep), view.project(deep), atol=1e-9)
    one = with_window(view, layers=(ACRYLIC,))
    halves = with_window(view, layers=(Layer(2e-3, 1.49), Layer(3e-3, 1.49)))
    np.testing.assert_allclose(halves.project(deep), one.project(deep), atol=1e-9)
    air = with_window(view, layers=(Layer(5e-3, 1.0),))
    lower = with_window(view, point=window.point - 5e-3 * window.normal)
    np.testing.assert_allclose(air.project(deep), lower.project(deep), atol=1e-8)
    # Acrylic does show.
    assert np.linalg.norm(one.project(deep) - view.project(deep), axis=1).min() > 0.05


def turned(camera: Camera, turn: np.ndarray) -> Camera:
    """The camera and its window, turned about rig's origin."""
    pose = camera.T_optical_rig.copy()
    pose[:3, :3] = pose[:3, :3] @ turn.T
    window = dataclasses.replace(
        camera.window, point=turn @ camera.window.point, normal=turn @ camera.window.normal
    )
    return dataclasses.replace(camera, T_optical_rig=pose, window=window)


@pytest.mark.parametrize("degrees", [90.0, -90.0, 37.0])
def test_a_view_from_aside_is_that_from_above_turned(
    calibration: StereoCalibration, degrees: float
) -> None:
    above = RefractedCamera(calibration.left)
    assert above.sideways.tolist() == [0.0, 1.0, 0.0]
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    aside = RefractedCamera(turned(calibration.left, turn))
    points = np.random.default_rng(0).uniform([-0.017, -0.03, 0.0], [0.03, 0.03, 0.12], (50, 3))
    np.testing.assert_allclose(aside.project(points @ turn.T), above.project(points), atol=1e-8)
    np.testing.assert_allclose(aside.sideways, turn @ above.sideways, atol=1e-12)
    grid, other = (make_search_grid(v, REACH, first_distance=2e-3) for v in (above, aside))
    np.testing.assert_allclose(other.pixels, grid.pixels, atol=1e-3)
    assert np.count_nonzero(other.reachable != grid.reachable) <= 2


def test_a_side_view_of_the_shipped_rig_searches_where_needles_go(
    top_and_side: StereoCalibration,
) -> None:
    """A needle that bends towards one camera lies on the grid's middle, there and nowhere else."""
    for number, view in enumerate(stereo_views(top_and_side)):
        grid = make_search_grid(view, REACH, first_distance=2e-3)
        assert grid.reachable[:, len(grid.angles) // 2].mean() > 0.9
        assert abs(view.sideways[1 - number]) > 0.999
        tip = np.array([0.0, 0.0, 0.1])
        tip[number] = 0.01
        column = np.linalg.norm(grid.pixels[grid.row_of(0.1)] - view.project(tip), axis=-1).argmin()
        assert abs(grid.angles[column]) < np.deg2rad(1.0)
        tip = np.array([0.0, 0.0, 0.1]) + 0.01 * view.sideways
        column = np.linalg.norm(grid.pixels[grid.row_of(0.1)] - view.project(tip), axis=-1).argmin()
        assert grid.angles[column] == pytest.approx(0.1, abs=np.deg2rad(0.5))


def test_a_corridor_lies_where_each_view_sees_the_way(top_and_side: StereoCalibration) -> None:
    length = np.linspace(0.005, 0.1, 30)
    way = np.stack([1.0 * length**2, -0.7 * length**2, length], axis=-1)
    for view in stereo_views(top_and_side):
        grid = make_search_grid(view, REACH, first_distance=2e-3)
        near = within_corridor(grid, view, way, np.full(len(way), 1e-3))
        for point in way[3:-1]:
            off = np.linalg.norm(grid.pixels - view.project(point), axis=-1)
            assert near.reachable[np.unravel_index(off.argmin(), off.shape)]
        assert near.reachable.sum() < 0.2 * grid.reachable.sum()


def test_height_and_depth_are_along_the_normal() -> None:
    window = Window(np.array([0.0, 0.02, 0.0]), np.array([0.0, 1.0, 0.0]), (ACRYLIC,), 1.34)
    points = np.array([[1.0, 0.03, 2.0], [0.0, 0.017, 0.0], [0.0, 0.0, 0.05]])
    np.testing.assert_allclose(window.height(points), [0.01, -0.003, -0.02], atol=1e-15)
    np.testing.assert_allclose(window.depth(points), [-0.015, -0.002, 0.015], atol=1e-15)
    surface = surface_from_above(0.0175, 1.3)
    assert surface.depth(np.array([0.0, 5.0, 5.0])) == pytest.approx(0.0175)
