"""Lenses and relative pose from files of ROS, Kalibr and OpenCV: reading, use and rejection."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from needle_core.errors import UserError
from needle_sim.camera.stereo_rig import StereoRig
from needle_tracker.calibrating.calibrate_stereo import figures, report
from needle_tracker.calibrating.calibration_outliers import contradictions
from needle_tracker.calibrating.calibration_session import BoardView
from needle_tracker.calibrating.imported_lenses import read_lenses
from needle_tracker.calibrating.rig_calibration import calibrate
from needle_tracker.optics.calibration import SIDES, StereoCalibration, load_calibration
from synthetic_rig import GIVEN, PLACES, SIZES, take

Content = dict[str, Any]


def pair(calibration: StereoCalibration) -> tuple[list[Any], list[Any], Any]:
    """Return camera matrices, lenses and T_right_left of a rig."""
    left, right = calibration.left, calibration.right
    pose = right.T_optical_rig @ np.linalg.inv(left.T_optical_rig)
    return [left.camera_matrix, right.camera_matrix], [left.distortion, right.distortion], pose


def ros(calibration: StereoCalibration) -> list[Content]:
    """Return the files that camera_calibration writes for left and right."""
    (m0, m1), (d0, d1), pose = pair(calibration)
    shift = pose[:3, 3].reshape(3, 1).copy()
    rectified = cv2.stereoRectify(
        m0, d0, m1, d1, SIZES["left"], pose[:3, :3].copy(), shift, flags=0, alpha=0
    )
    return [
        {
            "image_width": SIZES["left"][0],
            "image_height": SIZES["left"][1],
            "camera_matrix": {"data": (m0, m1)[i].ravel().tolist()},
            "distortion_model": "plumb_bob",
            "distortion_coefficients": {"data": (d0, d1)[i].tolist()},
            "rectification_matrix": {"data": rectified[i].ravel().tolist()},
            "projection_matrix": {"data": rectified[2 + i].ravel().tolist()},
        }
        for i in range(2)
    ]


def kalibr(calibration: StereoCalibration) -> Content:
    matrices, lenses, pose = pair(calibration)
    chain: Content = {
        f"cam{i}": {
            "camera_model": "pinhole",
            "intrinsics": m[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
            "distortion_model": "radtan",
            "distortion_coeffs": lens[:4].tolist(),
            "resolution": list(SIZES["left"]),
        }
        for i, (m, lens) in enumerate(zip(matrices, lenses, strict=True))
    }
    chain["cam1"]["T_cn_cnm1"] = pose.tolist()
    return chain


def written(path: Path, content: Content) -> Path:
    path.write_text(yaml.safe_dump(content, default_flow_style=None))
    return path


def storage(path: Path, content: Content) -> Path:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in content.items():
        file.write(key, value)
    file.release()
    return path


def all_formats(folder: Path, calibration: StereoCalibration) -> dict[str, list[Path]]:
    """Write the pair in the format of each tool; return the arguments of --lenses."""
    matrices, lenses, pose = pair(calibration)
    places, own = {"R": pose[:3, :3].copy(), "T": pose[:3, 3].copy()}, {}
    for end, (m, d) in {"yml": "MD", "xml": "KD", "json": ("cameraMatrix", "distCoeffs")}.items():
        own[end] = {f"{m}{i + 1}": matrices[i] for i in range(2)}
        own[end] |= {f"{d}{i + 1}": lenses[i][None] for i in range(2)}
    left, right = ros(calibration)
    split = [storage(folder / "extrinsics.yml", places), storage(folder / "in.yml", own["yml"])]
    return {
        "a ROS camera_info": [written(folder / "l.yaml", left), written(folder / "r.yaml", right)],
        "a Kalibr": [written(folder / "chain.yaml", kalibr(calibration))],
        "an OpenCV FileStorage": split,
        "an OpenCV": [storage(folder / "pair.xml", places | own["xml"])],
        "an OpenCV File": [storage(folder / "pair.json", places | own["json"])],
    }


def read(*paths: Path) -> StereoCalibration:
    return read_lenses(paths, SIZES, GIVEN)


def test_each_format_is_read_back(tmp_path: Path, calibration: StereoCalibration) -> None:
    matrices, lenses, pose = pair(calibration)
    for tool, paths in all_formats(tmp_path, calibration).items():
        found = read(*paths)
        for i, camera in enumerate((found.left, found.right)):
            np.testing.assert_allclose(camera.camera_matrix, matrices[i], atol=1e-6)
            np.testing.assert_allclose(camera.distortion, lenses[i], atol=1e-6)
        np.testing.assert_array_equal(found.left.T_optical_rig, np.eye(4))
        np.testing.assert_allclose(found.right.T_optical_rig, pose, atol=2e-6)
        # An error names the missing calibration of the rig.
        with pytest.raises(UserError, match=f"is {tool}.*`calibrate_stereo --lenses` takes it"):
            load_calibration(paths[-1])


def test_single_camera_files_of_opencv_have_no_relative_pose(
    tmp_path: Path, calibration: StereoCalibration
) -> None:
    paths = []
    for side, camera in zip(SIDES, (calibration.left, calibration.right), strict=True):
        parts: Content = {"image_width": camera.width, "image_height": camera.height}
        parts |= {"camera_matrix": camera.camera_matrix}
        parts |= {"distortion_coefficients": camera.distortion[:, None]}
        paths.append(storage(tmp_path / f"{side}.yml", parts))
    found = read(*paths)
    np.testing.assert_array_equal(found.right.T_optical_rig, np.eye(4))
    np.testing.assert_allclose(found.right.distortion, calibration.right.distortion)


def test_an_unusable_chain_is_rejected_with_the_reason(
    tmp_path: Path, calibration: StereoCalibration
) -> None:
    for camera, changes, cause in (
        ("cam0", {"camera_model": "omni"}, "cam0.camera_model 'omni' is not supported"),
        ("cam0", {"distortion_model": "fov"}, "fov with 4 coefficients"),
        ("cam0", {"distortion_coeffs": [0.1] * 6}, "radtan with 6 coefficients"),
        (
            "cam0",
            {"resolution": [2048, 1536]},
            "is for images of 2048x1536, the left ones are 1024",
        ),
        ("cam0", {"intrinsics": [0, 0, 512, 384]}, "left camera: focal lengths 0, 0 px"),
        ("cam1", {"T_cn_cnm1": [[2, 0, 0, 0]] * 4}, "is not a rotation"),
        ("cam1", {"T_cn_cnm1": None}, "cam1.T_cn_cnm1"),
        ("cam1", None, "found 1 of 2 cameras"),
    ):
        chain = kalibr(calibration)
        chain[camera].update(changes or {})
        if changes is None:
            del chain[camera]
        with pytest.raises(UserError, match=re.escape(cause)):
            read(written(tmp_path / "chain.yaml", chain))


def test_files_that_are_not_two_cameras_are_rejected(
    tmp_path: Path, calibration: StereoCalibration
) -> None:
    ros_files, chain, split, *_ = all_formats(tmp_path, calibration).values()
    broken = tmp_path / "broken.yml"
    broken.write_text(split[1].read_text().replace("data: [", "data: ["[:-1] + "{"))
    wide = written(tmp_path / "wide.yaml", ros(calibration)[0] | {"image_width": "wide"})
    for paths, cause in (
        (ros_files[:1] * 2, "a file is given twice"),
        (ros_files + chain, "found 4 of 2 cameras"),
        (split[:1], "found 0 of 2 cameras"),
        ([broken], "it is damaged"),
        ([wide], "wide.yaml, a ROS camera_info of one camera: image_width = 'wide' is not"),
        ([written(tmp_path / "own.yaml", {"phantom": {}})], "is neither a ROS camera_info"),
    ):
        with pytest.raises(UserError, match=cause):
            read(*paths)


def test_with_given_lenses_boards_at_known_places_suffice(
    calibration: StereoCalibration, views: list[BoardView], tmp_path: Path
) -> None:
    found = [view for view in views[6:] if view.name != "surface_b"]
    given = read(written(tmp_path / "chain.yaml", kalibr(calibration)))
    result = calibrate(found, SIZES, GIVEN, given)
    surface = result.calibration.surface
    assert surface is not None
    assert surface.inside == pytest.approx(1.3, abs=0.003)
    assert surface.point[0] == pytest.approx(0.0175, abs=0.3e-3)
    for side in SIDES:
        off = getattr(result.calibration, side).centre - getattr(calibration, side).centre
        assert np.linalg.norm(off) < 0.3e-3
    assert "left.fx" not in result.parameters
    assert any("lenses: as given" in line for line in report(result, 0.06))
    assert "left_fx_px" not in figures(result, 0.06)


def test_lenses_of_other_cameras_or_in_another_unit_are_rejected(
    rig: StereoRig, calibration: StereoCalibration, views: list[BoardView], tmp_path: Path
) -> None:
    far, swapped, longer = (kalibr(calibration) for _ in range(3))
    pose = np.array(far["cam1"]["T_cn_cnm1"])
    far["cam1"]["T_cn_cnm1"] = (pose * [1.0, 1.0, 1.0, 1e3]).tolist()
    swapped["cam1"]["T_cn_cnm1"] = np.linalg.inv(pose).tolist()
    for chain, cause in ((far, "is T in metres"), (swapped, "are left and right exchanged")):
        with pytest.raises(UserError, match=cause):
            calibrate(views[4:7], SIZES, GIVEN, read(written(tmp_path / "chain.yaml", chain)))
    for camera in ("cam0", "cam1"):
        longer[camera]["intrinsics"][0] *= 1.01
        longer[camera]["intrinsics"][1] *= 1.01
    given = read(written(tmp_path / "chain.yaml", longer))
    places = {name: place for name, place in PLACES.items() if name != "surface_b"}
    result = calibrate(take(rig, free=0, places=places), SIZES, GIVEN, given)
    texts = contradictions(result)
    assert any("another camera, focus or image size" in text for text in texts)
    assert not any("more distortion" in text for text in texts)
