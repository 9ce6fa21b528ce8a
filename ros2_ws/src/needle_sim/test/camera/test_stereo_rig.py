"""The calibration file's reader: the shipped file, and one line for every bad one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from needle_core.errors import UserError
from needle_sim.camera.stereo_rig import load_stereo_rig

CALIBRATION = Path(__file__).parents[3] / "needle_tracker" / "config" / "calibration.yaml"


def test_the_shipped_file_puts_both_cameras_where_its_header_says() -> None:
    rig = load_stereo_rig(CALIBRATION)
    assert rig.half_height == 0.0175
    for camera, y in ((rig.left, -0.1), (rig.right, 0.1)):
        window = camera.window
        assert (window.normal.tolist(), window.outer) == ([1.0, 0.0, 0.0], 0.0175)
        assert (window.thicknesses, window.indices) == ((), (1.3,))
        np.testing.assert_allclose(camera.centre, [0.5175, y, 0.0625], atol=1e-8)
        # Image u runs along rig z, v along rig y, the optical axis down.
        assert camera.T_optical_rig[0, 2] > 0.99
        assert camera.T_optical_rig[1, 1] > 0.97
        assert camera.T_optical_rig[2, 0] < -0.97
        assert (camera.image_width, camera.image_height) == (1024, 768)


TOP_AND_SIDE = CALIBRATION.with_name("calibration_top_and_side.yaml")


def test_each_camera_may_have_its_own_window() -> None:
    rig = load_stereo_rig(TOP_AND_SIDE)
    for camera, axis, outer in ((rig.left, 0, 0.0225), (rig.right, 1, 0.060)):
        window = camera.window
        assert window.normal[axis] > 0.9999
        assert window.outer == pytest.approx(outer, abs=0.3e-3)
        assert (window.thicknesses, window.indices) == ((0.005,), (1.49, 1.34))
        # The camera looks at its window.
        assert camera.T_optical_rig[2, axis] < -0.99
        assert float(window.height(camera.centre)) - window.outer == pytest.approx(0.5, abs=1e-3)
    assert rig.half_height == pytest.approx(0.0175, abs=0.3e-3)
    assert rig.half_width == pytest.approx(0.055, abs=0.3e-3)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda d: d.update(phantom={"surface_height": 0.0, "refractive_index": 1.3}), "beside"),
        (lambda d: d["right"].pop("window"), "right.window is missing, and so phantom is missing"),
        (lambda d: d["left"]["window"].pop("layers"), "left.window.layers is missing"),
        (lambda d: d["left"]["window"].update(normal=[0, 0, 1]), "lies along the needle"),
        (lambda d: d["left"]["window"].update(normal=[1, 1, 0]), "normal has length 1.41"),
        (lambda d: d["left"]["window"].update(normal=[-1, 0, 0]), "not above the surface"),
        (lambda d: d["left"]["window"].update(inside=0.9), r"inside = 0.9 is outside \[1, 3\]"),
        (lambda d: d["left"]["window"]["layers"][0].update(thickness=0), "thickness = 0 m"),
    ],
)
def test_a_bad_window_is_one_line(
    change: Callable[[dict[str, Any]], None], named: str, tmp_path: Path
) -> None:
    document = yaml.safe_load(TOP_AND_SIDE.read_text())
    change(document)
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(UserError, match=named) as caught:
        load_stereo_rig(path)
    assert "\n" not in str(caught.value)


def test_rotation_is_the_quaternion_s() -> None:
    rig = load_stereo_rig(CALIBRATION)
    quaternion = yaml.safe_load(CALIBRATION.read_text())["left"]["T_optical_rig"]["rotation"]
    np.testing.assert_allclose(
        rig.left.T_optical_rig[:3, :3], Rotation.from_quat(quaternion).as_matrix(), atol=1e-12
    )


def drop(*keys: str) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        for key in keys[:-1]:
            document = document[key]
        del document[keys[-1]]

    return change


def put(value: object, *keys: str) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        for key in keys[:-1]:
            document = document[key]
        document[keys[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (drop("phantom"), "phantom is missing"),
        (drop("left", "camera_matrix"), "left.camera_matrix is missing"),
        (drop("right", "T_optical_rig", "rotation"), "right.T_optical_rig.rotation is missing"),
        (put(0.9, "phantom", "refractive_index"), r"refractive_index = 0.9 is outside \[1, 3\]"),
        (put(float("nan"), "phantom", "surface_height"), "surface_height = nan"),
        (put(True, "phantom", "surface_height"), "surface_height = True"),
        (put(0.6, "phantom", "surface_height"), "not above the surface"),
        (put(0, "left", "image_width"), "left.image_width = 0 px"),
        (put(10.5, "left", "image_height"), "left.image_height = 10.5 px"),
        (put("fisheye", "left", "distortion_model"), "'fisheye' is not 'plumb_bob'"),
        (put([0] * 9, "left", "camera_matrix", "data"), "no pinhole matrix"),
        (put([1, 2], "left", "camera_matrix", "data"), "no list of 9 numbers"),
        (put(4, "left", "distortion_coefficients", "cols"), "is 1 x 4, not 1 x 5"),
        (put([0, 0, 0, 2], "left", "T_optical_rig", "rotation"), "norm 2, not 1"),
        (put("left", "left"), "left has no keys"),
    ],
)
def test_a_bad_file_is_named_in_one_line(
    tmp_path: Path, change: Callable[[dict[str, Any]], None], named: str
) -> None:
    document = yaml.safe_load(CALIBRATION.read_text())
    change(document)
    path = tmp_path / "bad.yaml"
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(UserError, match=named) as raised:
        load_stereo_rig(path)
    assert "bad.yaml" in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_file_that_cannot_be_read_is_named_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"absent\.yaml: cannot be read: No such file"):
        load_stereo_rig(tmp_path / "absent.yaml")
    broken = tmp_path / "broken.yaml"
    broken.write_text("left: [1, 2\nright: }")
    with pytest.raises(UserError, match="not YAML in line 2") as raised:
        load_stereo_rig(str(broken))
    assert "\n" not in str(raised.value)
    broken.write_text("")
    with pytest.raises(UserError, match="the file has no keys"):
        load_stereo_rig(broken)
