"""The reader of calibration files: the shipped files, and one-line errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from needle_core.errors import UserError
from needle_sim.camera.stereo_rig import StereoRig, load_stereo_rig

from .scenes import CALIBRATION, TOP_AND_SIDE


def test_the_camera_poses_of_the_shipped_file_match_its_header(rig: StereoRig) -> None:
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
    quaternion = yaml.safe_load(CALIBRATION.read_text())["left"]["T_optical_rig"]["rotation"]
    rotation = Rotation.from_quat(quaternion).as_matrix()
    np.testing.assert_allclose(rig.left.T_optical_rig[:3, :3], rotation, atol=1e-12)


def test_each_camera_may_have_its_own_window() -> None:
    rig = load_stereo_rig(TOP_AND_SIDE)
    for camera, axis, outer in ((rig.left, 0, 0.0225), (rig.right, 1, 0.060)):
        window = camera.window
        assert window.normal[axis] > 0.9999
        assert window.outer == pytest.approx(outer, abs=0.3e-3)
        assert (window.thicknesses, window.indices) == ((0.005,), (1.49, 1.34))
        # The camera faces its window.
        assert camera.T_optical_rig[2, axis] < -0.99
        assert float(window.height(camera.centre)) - window.outer == pytest.approx(0.5, abs=1e-3)
    assert rig.half_height == pytest.approx(0.0175, abs=0.3e-3)
    assert rig.half_width == pytest.approx(0.055, abs=0.3e-3)


GONE = object()
# Key in the file, invalid value, and key in the error.
BAD = [
    ("phantom", GONE, "phantom.surface_height is missing"),
    ("phantom.refractive_index", 0.9, "phantom.refractive_index = 0.9 is below 1"),
    ("phantom.surface_height", 0.6, "left.T_optical_rig puts the camera behind its window"),
    ("left.distortion_model", "fisheye", "'fisheye' is not 'plumb_bob'"),
    ("left.camera_matrix.data", [1, 2], r"data = \[1, 2\] is not 9 finite numbers"),
    ("left.T_optical_rig.rotation", [0, 0, 0, 2], "rotation has length 2, not 1"),
]
BAD_WINDOWS = [
    ("left.window.normal", [-1, 0, 0], "puts the camera behind its window"),
    ("left.window.layers.0.thickness", -1, "left.window.layers.0.thickness = -1 is below 0"),
]


@pytest.mark.parametrize(("shipped", "changes"), [(CALIBRATION, BAD), (TOP_AND_SIDE, BAD_WINDOWS)])
def test_a_bad_file_is_named_in_one_line(
    tmp_path: Path, shipped: Path, changes: list[tuple[str, Any, str]]
) -> None:
    path = tmp_path / "bad.yaml"
    text = shipped.read_text()
    for where, value, named in changes:
        document = part = yaml.load(text, yaml.CSafeLoader)
        *keys, last = where.split(".")
        for key in keys:
            part = part[int(key) if key.isdigit() else key]
        if value is GONE:
            del part[last]
        else:
            part[last] = value
        path.write_text(yaml.dump(document, Dumper=yaml.CSafeDumper))
        with pytest.raises(UserError, match=named) as raised:
            load_stereo_rig(path)
        assert "bad.yaml" in str(raised.value)
        assert "\n" not in str(raised.value)
