"""What the tests share: the calibration, settings, and images drawn by the tests themselves."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from needle_tracker.image.search_grid import Reach
from needle_tracker.optics.calibration import StereoCalibration, load_calibration
from needle_tracker.optics.refraction import RefractedCamera, stereo_views
from needle_tracker.tracking.gates import GateSettings
from needle_tracker.tracking.tracker_settings import TrackerSettings

CALIBRATION = Path(__file__).parents[1] / "config" / "calibration.yaml"


@pytest.fixture(scope="session")
def calibration_path() -> Path:
    return CALIBRATION


@pytest.fixture(scope="session")
def calibration() -> StereoCalibration:
    return load_calibration(CALIBRATION)


@pytest.fixture(scope="session")
def views(calibration: StereoCalibration) -> tuple[RefractedCamera, RefractedCamera]:
    return stereo_views(calibration)


@pytest.fixture
def settings(calibration: StereoCalibration) -> TrackerSettings:
    reach = Reach(curvature=9.0, entry_angle=math.radians(10), hole_tolerance=0.5e-3, length=0.15)
    gates = GateSettings(
        reach=reach,
        windows=(calibration.left.window, calibration.right.window),
        least_distance=4e-3,
        tip_lean=math.radians(12),
        insertion_margin=2e-3,
        step_margin=1.5e-3,
        free_step=5e-3,
        max_disagreement=1.5e-3,
        max_miss_px=1.0,
        max_depth_sigma=2e-3,
        confirm_pairs=3,
        lost_after=3,
        forget_after=30,
    )
    return TrackerSettings(
        gates=gates,
        needle_width=0.7e-3,
        bevel_length=0.0,
        bright=False,
        min_contrast=10.0,
        noise_factor=5.0,
        entry_zone=5e-3,
        hole_clearance=2e-3,
    )


def draw_line(
    shape: tuple[int, int], points: np.ndarray, width: float, level: float, background: float
) -> np.ndarray:
    """Return a float image with an anti-aliased polyline with square ends, by distance."""
    coverage = np.zeros(shape)
    cover_line(coverage, points, width)
    return background + (level - background) * coverage


def cover_line(coverage: np.ndarray, points: np.ndarray, width: float) -> None:
    """Raise the coverage of pixels, 0 to 1, to that of a polyline, about its pieces only."""
    shape = coverage.shape
    last = len(points) - 2
    for i, (first, second) in enumerate(itertools.pairwise(points)):
        low = np.maximum(np.floor(np.minimum(first, second) - width), 0).astype(int)
        high = np.ceil(np.maximum(first, second) + width).astype(int) + 1
        v, u = np.ogrid[low[1] : min(high[1], shape[0]), low[0] : min(high[0], shape[1])]
        length = float(np.linalg.norm(second - first))
        along_axis = (second - first) / length
        along = (u - first[0]) * along_axis[0] + (v - first[1]) * along_axis[1]
        across = np.abs((v - first[1]) * along_axis[0] - (u - first[0]) * along_axis[1])
        cover = np.clip(0.5 * width + 0.5 - across, 0, 1)
        # Square ends; inside, neighbouring pieces overlap.
        cover = cover * np.clip(length + (0.5 if i == last else 1.0) - along, 0, 1)
        cover = cover * np.clip(along + (0.5 if i == 0 else 1.0), 0, 1)
        block = coverage[low[1] : high[1], low[0] : high[0]]
        np.maximum(block, cover, out=block)


def arc(length: float, curvature: float, roll: float, pitch: float = 0.0) -> np.ndarray:
    """Return points of a needle path from the entry, (n, 3) in `rig`, and its tip last."""
    s = np.linspace(0.0, length, 120)
    if curvature == 0.0:
        side, ahead = np.zeros_like(s), s
    else:
        side = (1 - np.cos(curvature * s)) / curvature
        ahead = np.sin(curvature * s) / curvature
    x, y = side * math.sin(roll), side * math.cos(roll)
    return np.stack(
        [
            x * math.cos(pitch) + ahead * math.sin(pitch),
            y,
            ahead * math.cos(pitch) - x * math.sin(pitch),
        ],
        axis=-1,
    )


def _light_and_dark(view: RefractedCamera) -> tuple[np.ndarray, np.ndarray]:
    """Return the background of a view, and how far sheath and entry hole cover its pixels."""
    shape = (view.camera.height, view.camera.width)
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]]
    hole = view.project(np.zeros(3))
    dark = (np.hypot(u - hole[0], v - hole[1]) < 6.0).astype(float)
    cover_line(dark, view.project(np.array([[0.0, 0.0, -0.02], [0.0, 0.0, 0.0]])), 14.0)
    return 150.0 + 30.0 * np.sin(u / 300.0) + 25.0 * np.cos(v / 250.0), dark


@functools.lru_cache(maxsize=2)
def _grain(shapes: tuple[tuple[int, int], ...], seed: int, noise: float) -> list[np.ndarray]:
    """Return the images' noise; most tests draw one pair after another with the same."""
    rng = np.random.default_rng(seed)
    return [rng.normal(0.0, noise, shape) for shape in shapes]


Drawer = Callable[..., tuple[np.ndarray, np.ndarray]]


@pytest.fixture(scope="session")
def draw_pair(views: tuple[RefractedCamera, RefractedCamera]) -> Drawer:
    """Return a function that draws a needle, its sheath and the entry hole into both views."""
    empty = [_light_and_dark(view) for view in views]

    def draw(
        path: np.ndarray | None, seed: int = 0, noise: float = 3.0, bright: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        images = []
        for view, (light, always_dark), grain in zip(
            views, empty, _grain(tuple(light.shape for light, _ in empty), seed, noise), strict=True
        ):
            dark = always_dark.copy()
            if path is not None:
                cover_line(dark, view.project(path), 4.6)
            dark *= 90.0 if bright else -90.0
            dark += light
            dark += grain
            images.append(np.clip(np.round(dark, out=dark), 0, 255, out=dark).astype(np.uint8))
        return images[0], images[1]

    return draw


@pytest.fixture(scope="session")
def make_arc() -> Callable[..., np.ndarray]:
    return arc


@pytest.fixture(scope="session")
def make_line() -> Callable[..., np.ndarray]:
    return draw_line
