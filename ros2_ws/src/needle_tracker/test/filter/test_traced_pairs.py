"""The tracker on path-traced pairs: steel under lamps, over floors and before clutter."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from needle_tracker.filter.needle_tracker import Image, NeedleTracker
from needle_tracker.optics.calibration import Camera, StereoCalibration, load_calibration
from needle_tracker.stereo.triangulation import SpatialTip
from needle_tracker.tracker_parameters import StereoTrackerParameters

SCENES = Path(__file__).parents[1] / "data" / "traced"
SIDES = ("left", "right")
_CHI_SQUARED_999 = 16.27  # of three degrees of freedom


def cut(camera: Camera, crop: list[int]) -> Camera:
    """Return a camera cropped to a part of the image."""
    column, row, width, height = crop
    matrix = camera.camera_matrix.copy()
    matrix[:2, 2] -= column, row
    return dataclasses.replace(camera, width=width, height=height, camera_matrix=matrix)


def read(folder: Path, name: str) -> tuple[Image, Image]:
    images = [
        cv2.imread(str(folder / side / f"{name}.png"), cv2.IMREAD_GRAYSCALE) for side in SIDES
    ]
    assert images[0] is not None
    assert images[1] is not None
    return np.asarray(images[0], np.uint8), np.asarray(images[1], np.uint8)


def tracked(
    calibration: StereoCalibration,
    name: str,
    *,
    empty: bool,
    insertion: bool = True,
) -> list[tuple[SpatialTip | None, np.ndarray]]:
    """Return the result for each pair of a scene, and the truth; a box has its own cameras."""
    folder = SCENES / name
    scene: dict[str, Any] = yaml.safe_load((folder / "scene.yaml").read_text(encoding="utf-8"))
    if (folder / "calibration.yaml").is_file():
        calibration = load_calibration(folder / "calibration.yaml")
    left, right = (cut(getattr(calibration, side), scene["crop"][side]) for side in SIDES)
    cut_out = StereoCalibration(left, right)
    settings = StereoTrackerParameters(needle_width=scene["diameter"])
    tracker = NeedleTracker(cut_out, settings, read(folder, "empty") if empty else None)
    return [
        (
            tracker.process(
                *read(folder, pair["name"]), pair["insertion"] if insertion else None
            ).tip,
            np.array(pair.get("tip", [])),
        )
        for pair in scene["pairs"]
    ]


@pytest.mark.parametrize("name", ["steel_on_dark", "steel_on_brushed_metal"])
def test_a_steel_needle_is_found_with_a_realistic_covariance(
    calibration: StereoCalibration, name: str
) -> None:
    squares = []
    for tip, truth in tracked(calibration, name, empty=False)[1:]:
        assert tip is not None
        off = tip.position - truth
        assert np.linalg.norm(off) < 1e-3
        squares.append(off @ np.linalg.solve(tip.covariance, off))
    assert np.mean(np.array(squares) < _CHI_SQUARED_999) > 0.5


@pytest.mark.parametrize("empty", [False, True])
def test_a_line_of_paper_along_the_needle_does_not_bias_the_tip(
    calibration: StereoCalibration, empty: bool
) -> None:
    for tip, truth in tracked(calibration, "steel_on_graph_paper", empty=empty):
        assert tip is None or np.linalg.norm(tip.position - truth) < 1e-3


def test_without_the_insertion_no_tip_over_graph_paper_is_immediate_or_wrong(
    calibration: StereoCalibration,
) -> None:
    looks = tracked(calibration, "steel_on_graph_paper", empty=True, insertion=False)
    assert looks[0][0] is None
    for tip, truth in looks:
        assert tip is None or np.linalg.norm(tip.position - truth) < 0.75e-3


KNOWN = [
    {"empty": True, "insertion": True},
    {"empty": False, "insertion": True},
    {"empty": False, "insertion": False},
]


@pytest.mark.parametrize("known", KNOWN)
@pytest.mark.parametrize("name", ["box_steel", "box_clutter"])
def test_a_needle_in_a_box_before_clutter_is_found_through_its_walls(
    calibration: StereoCalibration, name: str, known: dict[str, bool]
) -> None:
    for tip, truth in tracked(calibration, name, **known)[2:]:
        assert tip is not None
        off = tip.position - truth
        assert np.linalg.norm(off) < 0.5e-3
        assert off @ np.linalg.solve(tip.covariance, off) < _CHI_SQUARED_999


@pytest.mark.parametrize("known", KNOWN)
def test_old_tracks_and_rails_behind_a_box_are_rejected(
    calibration: StereoCalibration, known: dict[str, bool]
) -> None:
    assert not any(tip for tip, _ in tracked(calibration, "box_empty", **known))
