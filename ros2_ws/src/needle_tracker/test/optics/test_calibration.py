"""A calibration file is read as it says, and a bad one is one line that says where."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from needle_core.errors import UserError
from needle_tracker.optics.calibration import load_calibration, parse_calibration, rotation_matrix


@pytest.fixture
def content(calibration_path: Path) -> Any:
    return copy.deepcopy(yaml.safe_load(calibration_path.read_text(encoding="utf-8")))


def test_cameras_look_down_from_above_the_surface(calibration_path: Path) -> None:
    calibration = load_calibration(calibration_path)
    assert calibration.left.window.height(calibration.left.centre) > 0.0
    viewing = calibration.left.T_optical_rig[2, :3]
    assert viewing[0] < -0.9


def test_rotation_agrees_with_scipy() -> None:
    for seed in range(20):
        rotation = Rotation.random(rng=np.random.default_rng(seed))
        np.testing.assert_allclose(
            rotation_matrix(rotation.as_quat()), rotation.as_matrix(), atol=1e-14
        )


def test_rotation_is_normalised(content: Any) -> None:
    pose = content["left"]["T_optical_rig"]
    pose["rotation"] = [1.005 * part for part in pose["rotation"]]
    rotation = parse_calibration(content).left.T_optical_rig[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)


def _drop_right(content: Any) -> None:
    del content["right"]


def _index_below_air(content: Any) -> None:
    content["phantom"]["refractive_index"] = 0.9


def _nan_height(content: Any) -> None:
    content["phantom"]["surface_height"] = float("nan")


def _short_distortion(content: Any) -> None:
    content["left"]["distortion_coefficients"]["data"] = [0.0] * 4


def _other_model(content: Any) -> None:
    content["left"]["distortion_model"] = "equidistant"


def _no_rotation(content: Any) -> None:
    content["right"]["T_optical_rig"]["rotation"] = [0.0, 0.0, 0.0, 0.1]


def _text_for_size(content: Any) -> None:
    content["left"]["image_width"] = "wide"


def _negative_focal_length(content: Any) -> None:
    content["left"]["camera_matrix"]["data"][0] = -1.0


def _skew(content: Any) -> None:
    content["left"]["camera_matrix"]["data"][1] = 0.5


def _surface_above_cameras(content: Any) -> None:
    content["phantom"]["surface_height"] = 2.0


def _one_place(content: Any) -> None:
    content["right"]["T_optical_rig"] = content["left"]["T_optical_rig"]


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (_drop_right, "right"),
        (_index_below_air, "refractive_index"),
        (_nan_height, "surface_height"),
        (_short_distortion, "left.distortion_coefficients"),
        (_other_model, "plumb_bob"),
        (_no_rotation, "right.T_optical_rig.rotation"),
        (_text_for_size, "left.image_width"),
        (_negative_focal_length, "left.camera_matrix"),
        (_skew, "left.camera_matrix"),
        (_surface_above_cameras, "not above the surface"),
        (_one_place, "same place"),
    ],
)
def test_bad_content_is_named(
    content: Any, spoil: Callable[[Any], None], named: str, tmp_path: Path
) -> None:
    spoil(content)
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    with pytest.raises(UserError, match=named) as caught:
        load_calibration(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.fixture
def own_windows(calibration_path: Path) -> Any:
    path = calibration_path.with_name("calibration_top_and_side.yaml")
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def test_the_one_surface_is_both_windows(content: Any) -> None:
    calibration = parse_calibration(content)
    for camera in (calibration.left, calibration.right):
        assert camera.window.point.tolist() == [0.0175, 0.0, 0.0]
        assert camera.window.normal.tolist() == [1.0, 0.0, 0.0]
        assert (camera.window.layers, camera.window.inside) == ((), 1.3)
    assert calibration.surface is calibration.left.window
    # Said of each camera, it is the same surface.
    del content["phantom"]
    window = {"point": [0.0175, 0.1, 0.2], "normal": [1, 0, 0], "layers": [], "inside": 1.3}
    for side in ("left", "right"):
        content[side]["window"] = window
    surface = parse_calibration(content).surface
    assert surface is not None
    assert (surface.point[0], surface.inside) == (0.0175, 1.3)


def test_windows_are_read_as_they_stand(own_windows: Any) -> None:
    calibration = parse_calibration(own_windows)
    assert calibration.surface is None
    window = calibration.right.window
    assert window.point.tolist() == [0.0, 0.06, 0.0625]
    assert window.normal[1] == pytest.approx(0.99998, abs=1e-5)
    assert [(layer.thickness, layer.refractive_index) for layer in window.layers] == [(0.005, 1.49)]
    assert window.inside == 1.34
    # 500 mm before the outer faces.
    for camera in (calibration.left, calibration.right):
        assert float(camera.window.height(camera.centre)) == pytest.approx(0.5, abs=1e-3)


def put(*keys: Any) -> Callable[[Any], None]:
    """Return what sets the value at the last key but one to the last."""

    def change(content: Any) -> None:
        for key in keys[:-2]:
            content = content[key]
        content[keys[-2]] = keys[-1]

    return change


def _no_window(content: Any) -> None:
    for side in ("left", "right"):
        del content[side]["window"]


def _one_window(content: Any) -> None:
    del content["right"]["window"]


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (put("phantom", {"surface_height": 0.01, "refractive_index": 1.3}), "take phantom out"),
        (_no_window, "phantom is missing.*give phantom .*or each camera its window"),
        (_one_window, "right.window.point is missing"),
        (put("left", "window", "normal", [2.0, 0.0, 0.0]), "length of left.window.normal"),
        (put("left", "window", "normal", [0.0, 0.1, 0.995]), "needle's axis"),
        (put("left", "window", "normal", [-1.0, 0.0, 0.0]), "normal points to the camera"),
        (put("left", "window", "layers", None), "layers = None is not a list"),
        (put("left", "window", "layers", [{"thickness": 0.005}]), "layers.0..refractive_index"),
        (put("right", "window", "layers", 0, "thickness", -1e-3), "layers.0..thickness"),
        (put("right", "window", "layers", 0, "thickness", 5), "right.window.layers.0..thickness"),
        (put("right", "window", "inside", 0.9), "right.window.inside"),
        (put("right", "window", "point", [0.0, 0.06]), "right.window.point wants 3 numbers"),
    ],
)
def test_bad_windows_are_named(own_windows: Any, spoil: Callable[[Any], None], named: str) -> None:
    spoil(own_windows)
    with pytest.raises(UserError, match=named) as caught:
        parse_calibration(own_windows)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "[1, 2]", "{a: [", "phantom: 3"])
def test_other_files_are_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UserError):
        load_calibration(path)


def test_missing_and_binary_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="No such file"):
        load_calibration(tmp_path / "none.yaml")
    binary = tmp_path / "image.yaml"
    binary.write_bytes(b"\xff\xfe\x80\x81")
    with pytest.raises(UserError, match="not a text file"):
        load_calibration(binary)
