"""Calibration files: content, and one-line errors that name the place."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from needle_core.errors import UserError
from needle_tracker.optics.calibration import load_calibration, parse_calibration

SIDES = ("left", "right")


@pytest.fixture
def content(calibration_path: Path) -> Any:
    return yaml.safe_load(calibration_path.read_text(encoding="utf-8"))


@pytest.fixture
def own_windows(calibration_path: Path) -> Any:
    path = calibration_path.with_name("calibration_top_and_side.yaml")
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def test_rotations_are_normalized(content: Any) -> None:
    pose = content["left"]["T_optical_rig"]
    pose["rotation"] = [1.005 * part for part in pose["rotation"]]
    found = parse_calibration(content).left.T_optical_rig[:3, :3]
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-14)


def test_a_common_surface_is_the_window_of_both_cameras(content: Any) -> None:
    calibration = parse_calibration(content)
    for camera in (calibration.left, calibration.right):
        assert camera.window.point.tolist() == [0.0175, 0.0, 0.0]
        assert camera.window.normal.tolist() == [1.0, 0.0, 0.0]
        assert (camera.window.layers, camera.window.inside) == ((), 1.3)
        # Both cameras look down from above the surface.
        assert camera.window.height(camera.centre) > 0.0
        assert camera.T_optical_rig[2, 0] < -0.9
    assert calibration.surface is calibration.left.window
    # Given for each camera separately, it is the same surface.
    del content["phantom"]
    window = {"point": [0.0175, 0.1, 0.2], "normal": [1, 0, 0], "layers": [], "inside": 1.3}
    for side in SIDES:
        content[side]["window"] = window
    surface = parse_calibration(content).surface
    assert surface is not None
    assert (surface.point[0], surface.inside) == (0.0175, 1.3)


def test_windows_are_read(own_windows: Any) -> None:
    calibration = parse_calibration(own_windows)
    assert calibration.surface is None
    window = calibration.right.window
    assert window.point.tolist() == [0.0, 0.06, 0.0625]
    assert window.normal[1] == pytest.approx(0.99998, abs=1e-5)
    assert [(layer.thickness, layer.refractive_index) for layer in window.layers] == [(0.005, 1.49)]
    assert window.inside == 1.34
    # 500 mm in front of the outer faces.
    for camera in (calibration.left, calibration.right):
        assert float(camera.window.height(camera.centre)) == pytest.approx(0.5, abs=1e-3)


def put(*keys: Any) -> Callable[[Any], None]:
    """Return a function that sets the value at all keys but the last to the last."""

    def change(content: Any) -> None:
        for key in keys[:-2]:
            content = content[key]
        content[keys[-2]] = keys[-1]

    return change


def one_place(content: Any) -> None:
    content["right"]["T_optical_rig"] = content["left"]["T_optical_rig"]


def test_bad_content_is_named(calibration_path: Path, tmp_path: Path) -> None:
    text, path = calibration_path.read_text(encoding="utf-8"), tmp_path / "rig.yaml"
    for spoil, named in (
        (lambda content: content.pop("right"), "right"),
        (put("phantom", "refractive_index", 0.9), "refractive_index"),
        (put("phantom", "surface_height", float("nan")), "surface_height"),
        (put("phantom", "surface_height", 2.0), "not above the surface"),
        (put("left", "distortion_coefficients", "data", [0.0] * 4), "left.distortion_coeff"),
        (put("left", "distortion_model", "equidistant"), "plumb_bob"),
        (put("left", "image_width", "wide"), "left.image_width"),
        (put("left", "camera_matrix", "data", 0, -1.0), "left.camera_matrix"),
        (put("left", "camera_matrix", "data", 1, 0.5), "left.camera_matrix"),
        (put("right", "T_optical_rig", "rotation", [0, 0, 0, 0.1]), "right.T_optical_rig.rotation"),
        (one_place, "same place"),
    ):
        content = yaml.safe_load(text)
        spoil(content)
        path.write_text(yaml.safe_dump(content), encoding="utf-8")
        with pytest.raises(UserError, match=named) as caught:
            load_calibration(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)


def no_window(content: Any) -> None:
    for side in SIDES:
        del content[side]["window"]


def test_bad_windows_are_named(own_windows: Any) -> None:
    for spoil, named in (
        (put("phantom", {"surface_height": 0.01, "refractive_index": 1.3}), "take phantom out"),
        (no_window, "phantom is missing.*give phantom .*or each camera its window"),
        (lambda content: content["right"].pop("window"), "right.window.point is missing"),
        (put("left", "window", "normal", [2.0, 0.0, 0.0]), "length of left.window.normal"),
        (put("left", "window", "normal", [0.0, 0.1, 0.995]), "needle's axis"),
        (put("left", "window", "normal", [-1.0, 0.0, 0.0]), "normal must point to the camera"),
        (put("left", "window", "layers", None), "layers = None is not a list"),
        (put("left", "window", "layers", [{"thickness": 0.005}]), "layers.0..refractive_index"),
        (put("right", "window", "layers", 0, "thickness", -1e-3), "layers.0..thickness"),
        (put("right", "window", "inside", 0.9), "right.window.inside"),
        (put("right", "window", "point", [0.0, 0.06]), "right.window.point needs 3 numbers"),
    ):
        content = copy.deepcopy(own_windows)
        spoil(content)
        with pytest.raises(UserError, match=named) as caught:
            parse_calibration(content)
        assert "\n" not in str(caught.value)
    for other in ([1, 2], {"phantom": 3}):
        with pytest.raises(UserError, match="phantom"):
            parse_calibration(other)
