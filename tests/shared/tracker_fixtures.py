"""Fixtures of tests of the tracker: the rig, the parameters, and drawn images."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drawn_needles import cover_line
from needle_core.files.installed import find_shared_file
from needle_tracker.optics.calibration import StereoCalibration, load_calibration
from needle_tracker.optics.refraction import RefractedCamera, stereo_views
from needle_tracker.tracker_parameters import StereoTrackerParameters

__all__ = ["calibration", "calibration_path", "draw_pair", "settings", "views"]


@pytest.fixture(scope="session")
def calibration_path() -> Path:
    return find_shared_file("needle_tracker", "config/calibration.yaml")


@pytest.fixture(scope="session")
def calibration(calibration_path: Path) -> StereoCalibration:
    return load_calibration(calibration_path)


@pytest.fixture(scope="session")
def views(calibration: StereoCalibration) -> tuple[RefractedCamera, RefractedCamera]:
    return stereo_views(calibration)


@pytest.fixture
def settings() -> StereoTrackerParameters:
    return StereoTrackerParameters()


def _light_and_dark(view: RefractedCamera) -> tuple[np.ndarray, np.ndarray]:
    """Return the background of a view, and the coverage of its pixels by sheath and entry hole."""
    shape = (view.camera.height, view.camera.width)
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]]
    hole = view.project(np.zeros(3))
    dark = (np.hypot(u - hole[0], v - hole[1]) < 6.0).astype(float)
    cover_line(dark, view.project(np.array([[0.0, 0.0, -0.02], [0.0, 0.0, 0.0]])), 14.0)
    return 150.0 + 30.0 * np.sin(u / 300.0) + 25.0 * np.cos(v / 250.0), dark


@functools.lru_cache(maxsize=2)
def _grain(shapes: tuple[tuple[int, int], ...], seed: int, noise: float) -> list[np.ndarray]:
    """Return the images' noise; cached, because most tests draw several pairs with the same."""
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
