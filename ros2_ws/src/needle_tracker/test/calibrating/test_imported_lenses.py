"""Lenses and relative pose from files of ROS, Kalibr and OpenCV: read, calibrated with, refused."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from needle_core.errors import UserError
from needle_tracker.answers.track_images import main as track_images
from needle_tracker.calibrating.calibrate_stereo import main as calibrate_stereo
from needle_tracker.calibrating.calibration_outliers import doubts, square_error
from needle_tracker.calibrating.imported_lenses import read_lenses
from needle_tracker.calibrating.rig_calibration import calibrate
from needle_tracker.optics.calibration import StereoCalibration, load_calibration

from .box_session import GIVEN as GIVEN_BOX
from .box_session import SMALL_BOARD, take_in_box
from .session import record
from .synthetic_rig import SIDES, SIZE, TrueRig, given, surface_places, take, under_places

Array = NDArray[np.float64]
Content = dict[str, Any]

GIVEN = given(0.0175, 1.33)
SIZES = dict.fromkeys(SIDES, SIZE)
# A made-up pair, 42.9 mm apart: x_right = R x_left + T [m].
MATRICES = [
    np.array([[1662.4, 0, 531.7], [0, 1660.9, 401.2], [0, 0, 1]]),
    np.array([[1654.1, 0, 506.3], [0, 1652.8, 377.4], [0, 0, 1]]),
]
LENSES = [[-0.2801, -0.2403, 0.0004, -0.0003, 0.0], [-0.324, -0.0834, -0.0002, 0.0005, 0.0]]
BESIDE = (cv2.Rodrigues(np.array([0.011, -0.138, 0.004]))[0], np.array([-0.0428, 0.0006, 0.0031]))
ABOVE = (cv2.Rodrigues(np.array([0.138, 0.011, 0.004]))[0], np.array([0.0006, -0.0428, 0.0031]))
STRONG = [2.5, 1.2, 0.0003, -0.0002, 0.05, 2.85, 2.0, 0.25]


def matrix(array: Array, rows: int) -> Content:
    data = [round(float(value), 6) for value in np.ravel(array)]
    return {"rows": rows, "cols": len(data) // rows, "data": data}


def ros(matrices: list[Array], lenses: list[Any], pose: tuple[Array, Array]) -> list[Content]:
    """What camera_calibration writes of left and right."""
    left, right = ((m, np.array(lens)) for m, lens in zip(matrices, lenses, strict=True))
    shift = pose[1].reshape(3, 1)
    rectified = cv2.stereoRectify(*left, *right, SIZE, pose[0], shift, flags=0, alpha=0)
    return [
        {
            "image_width": SIZE[0],
            "image_height": SIZE[1],
            "camera_name": f"stereo/{side}",
            "camera_matrix": matrix(matrices[i], 3),
            "distortion_model": "plumb_bob",
            "distortion_coefficients": matrix(np.array(lenses[i]), 1),
            "rectification_matrix": matrix(rectified[i], 3),
            "projection_matrix": matrix(rectified[2 + i], 3),
        }
        for i, side in enumerate(SIDES)
    ]


def kalibr(matrices: list[Array], lenses: list[Any], pose: tuple[Array, Array]) -> Content:
    chain = {
        f"cam{i}": {
            "camera_model": "pinhole",
            "intrinsics": [float(m[0, 0]), float(m[1, 1]), float(m[0, 2]), float(m[1, 2])],
            "distortion_model": "radtan",
            "distortion_coeffs": [float(value) for value in lens[:4]],
            "resolution": list(SIZE),
            "rostopic": f"/cam{i}/image_raw",
        }
        for i, (m, lens) in enumerate(zip(matrices, lenses, strict=True))
    }
    chain["cam1"]["T_cn_cnm1"] = np.vstack([np.column_stack(pose), [0.0, 0.0, 0.0, 1.0]]).tolist()
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


def all_formats(
    folder: Path, matrices: list[Array], lenses: list[Any], pose: tuple[Array, Array]
) -> dict[str, list[Path]]:
    """Write the pair as each of the tools does; returns what follows --lenses."""
    names = [folder / f"ros_{side}.yaml" for side in SIDES]
    for path, content in zip(names, ros(matrices, lenses, pose), strict=True):
        written(path, content)
    intrinsics: Content = {}
    for number in "12":
        i = int(number) - 1
        intrinsics |= {"M" + number: matrices[i], "D" + number: np.array([lenses[i]])}
    extrinsics = {"R": pose[0], "T": pose[1].reshape(3, 1)}
    return {
        "ros": names,
        "kalibr": [written(folder / "chain.yaml", kalibr(matrices, lenses, pose))],
        **{
            f"opencv_{end}": [
                storage(folder / f"extrinsics.{end}", extrinsics),
                storage(folder / f"intrinsics.{end}", intrinsics),
            ]
            for end in ("yml", "xml", "json")
        },
    }


FORMATS = ("ros", "kalibr", "opencv_yml", "opencv_xml", "opencv_json")


def read(*paths: Path) -> StereoCalibration:
    return read_lenses(paths, SIZES, GIVEN)


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("pose", [BESIDE, ABOVE], ids=["beside", "above"])
def test_each_format_gives_the_pair_that_was_written(
    tmp_path: Path, name: str, pose: tuple[Array, Array]
) -> None:
    found = read(*all_formats(tmp_path, MATRICES, LENSES, pose)[name])
    for i, camera in enumerate((found.left, found.right)):
        np.testing.assert_allclose(camera.camera_matrix, MATRICES[i], atol=1e-6)
        np.testing.assert_allclose(camera.distortion, LENSES[i], atol=1e-6)
    np.testing.assert_array_equal(found.left.T_optical_rig, np.eye(4))
    np.testing.assert_allclose(found.right.T_optical_rig[:3, :3], pose[0], atol=2e-6)
    np.testing.assert_allclose(found.right.T_optical_rig[:3, 3], pose[1], atol=1e-6)


@pytest.mark.parametrize("keys", [("K", "D"), ("cameraMatrix", "distCoeffs")])
def test_other_names_of_opencv_matrices(tmp_path: Path, keys: tuple[str, str]) -> None:
    parts: Content = {"R": BESIDE[0], "T": BESIDE[1].reshape(1, 3)}
    for i in range(2):
        parts |= {f"{keys[0]}{i + 1}": MATRICES[i], f"{keys[1]}{i + 1}": np.array([LENSES[i]]).T}
    found = read(storage(tmp_path / "pair.yml", parts))
    np.testing.assert_allclose(found.right.camera_matrix, MATRICES[1])
    np.testing.assert_allclose(found.left.distortion, LENSES[0])
    np.testing.assert_allclose(found.right.T_optical_rig[:3, 3], BESIDE[1])


def test_a_file_for_each_camera_of_opencv_leaves_their_pose_open(tmp_path: Path) -> None:
    paths = []
    for i, side in enumerate(SIDES):
        parts: Content = {"image_width": SIZE[0], "image_height": SIZE[1]}
        parts |= {"camera_matrix": MATRICES[i], "distortion_coefficients": np.array([LENSES[i]]).T}
        paths.append(storage(tmp_path / f"{side}.yml", parts))
    found = read(*paths)
    np.testing.assert_array_equal(found.right.T_optical_rig, np.eye(4))
    np.testing.assert_allclose(found.right.distortion, LENSES[1])


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("rational_polynomial", STRONG), ("equidistant", [-0.02, 0.01, -0.008, 0.002])],
)
def test_another_model_of_a_narrow_lens_becomes_plumb_bob(
    tmp_path: Path, model: str, coefficients: list[float]
) -> None:
    paths = []
    for content, path in zip(ros(MATRICES, LENSES, BESIDE), ("l.yaml", "r.yaml"), strict=True):
        content |= {"distortion_model": model}
        content["distortion_coefficients"] = matrix(np.array(coefficients), 1)
        paths.append(written(tmp_path / path, content))
    camera = read(*paths).left
    points = np.random.default_rng(0).uniform([-0.2, -0.15, 1.0], [0.2, 0.15, 1.0], (50, 3))
    nothing, lens = np.zeros(3), np.array(coefficients)
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    true, _ = project(points.reshape(-1, 1, 3), nothing, nothing, MATRICES[0], lens)
    same, _ = cv2.projectPoints(points, nothing, nothing, MATRICES[0], camera.distortion)
    np.testing.assert_allclose(same.reshape(-1, 2), true.reshape(-1, 2), atol=0.05)


def in_chain(**values: Any) -> Callable[[Content], None]:
    return lambda chain: chain["cam0"].update(values)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (in_chain(camera_model="omni"), "cam0.camera_model 'omni' is not supported"),
        (in_chain(distortion_model="fov", distortion_coeffs=[0.9]), "fov with 1 coefficients"),
        (
            in_chain(
                intrinsics=[420.0, 420.0, 512.0, 384.0],
                distortion_model="equidistant",
                distortion_coeffs=[-0.02, 0.01, -0.008, 0.002],
            ),
            "plumb_bob misses its equidistant lens by",
        ),
        (in_chain(resolution=[2048, 1536]), "is for images of 2048x1536, the left ones are 1024"),
        (in_chain(intrinsics=[0.0, 0.0, 512.0, 384.0]), "left camera: focal lengths 0, 0 px"),
        (lambda chain: chain["cam1"].pop("T_cn_cnm1"), "cam1.T_cn_cnm1 is missing"),
        (lambda chain: chain.pop("cam1"), "found 1 of 2 cameras"),
        (
            lambda chain: chain["cam1"].update(T_cn_cnm1=np.diag([2.0, 2, 2, 1]).tolist()),
            "is no rotation",
        ),
    ],
)
def test_a_chain_that_cannot_be_used_says_why(
    tmp_path: Path, spoil: Callable[[Content], None], says: str
) -> None:
    chain = kalibr(MATRICES, LENSES, BESIDE)
    spoil(chain)
    with pytest.raises(UserError, match=re.escape(says)):
        read(written(tmp_path / "chain.yaml", chain))


def test_files_that_are_not_two_cameras_are_refused(tmp_path: Path) -> None:
    formats = all_formats(tmp_path, MATRICES, LENSES, BESIDE)
    for paths, says in (
        (formats["ros"][:1], "found 1 of 2 cameras"),
        (formats["ros"][:1] * 2, "a file is given twice"),
        (formats["ros"] + formats["kalibr"], "found 4 of 2 cameras"),
        (formats["opencv_yml"][:1], "found 0 of 2 cameras"),
        ([written(tmp_path / "own.yaml", {"phantom": {}})], "is neither a ROS camera_info"),
    ):
        with pytest.raises(UserError, match=says):
            read(*paths)


@pytest.mark.parametrize("name", FORMATS)
def test_where_the_rigs_own_calibration_is_expected_the_format_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    path = all_formats(tmp_path, MATRICES, LENSES, BESIDE)[name][-1]
    words = ["--calibration", str(path), "--left", str(tmp_path), "--right", str(tmp_path)]
    assert track_images([*words, "--output", str(tmp_path / "tips.csv")]) == 2
    tool = {"ros": "a ROS camera_info", "kalibr": "a Kalibr"}.get(name, "an OpenCV FileStorage")
    said = capsys.readouterr().err
    assert f"calibration {path} is {tool}" in said
    assert "`calibrate_stereo --lenses` takes it, see docs/calibration.md" in said


def truth(rig: TrueRig) -> tuple[list[Array], list[Any], tuple[Array, Array]]:
    """Return matrices, lenses and relative pose of a rig."""
    (k0, d0, r0, t0), (k1, d1, r1, t1) = (rig.camera(side) for side in SIDES)
    rotation = r1 @ r0.T
    return [k0, k1], [d0.tolist(), d1.tolist()], (rotation, t1 - rotation @ t0)


@pytest.fixture(scope="module")
def places_alone(calibration_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of one board on the surface and of three under it."""
    folder = tmp_path_factory.mktemp("places")
    places = surface_places(0.0175) | under_places(0.0175)
    places.pop("surface_b")
    record(folder, TrueRig.read(calibration_path), places, free=0)
    return folder


@pytest.mark.parametrize("name", FORMATS[:3])
def test_boards_at_known_places_alone_give_the_rest(
    calibration_path: Path, places_alone: Path, tmp_path: Path, name: str
) -> None:
    rig = TrueRig.read(calibration_path)
    files = [str(path) for path in all_formats(tmp_path, *truth(rig))[name]]
    words = [word for side in SIDES for word in (f"--{side}", str(places_alone / side))]
    output = tmp_path / "rig.yaml"
    words += ["--session", str(places_alone / "session.yaml"), "--output", str(output)]
    assert calibrate_stereo([*words, "--lenses", *files]) == 0
    found = load_calibration(output)
    assert found.surface is not None
    assert found.surface.inside == pytest.approx(rig.index, abs=0.003)
    assert found.surface.point[0] == pytest.approx(rig.height, abs=0.3e-3)
    for side in SIDES:
        _, _, rotation, translation = rig.camera(side)
        centre = getattr(found, side).centre
        assert np.linalg.norm(centre + rotation.T @ translation) < 0.3e-3


def test_with_a_window_for_each_camera_a_board_in_the_box_is_enough(
    calibration_path: Path, tmp_path: Path
) -> None:
    path = calibration_path.with_name("calibration_top_and_side.yaml")
    rig = TrueRig.read(path, SMALL_BOARD)
    files = all_formats(tmp_path, *truth(rig))["kalibr"]
    lenses = read_lenses(files, SIZES, GIVEN_BOX)
    result = calibrate(take_in_box(rig, air=0, box=6, seed=0), SIZES, GIVEN_BOX, lenses)
    assert result.tip_error_p95 < 120e-6
    assert "left.fx" not in result.parameters


def test_a_pair_in_another_unit_or_exchanged_is_refused(
    calibration_path: Path, tmp_path: Path
) -> None:
    rig = TrueRig.read(calibration_path)
    views = take(rig, np.random.default_rng(0), free=2)
    matrices, lenses, (rotation, translation) = truth(rig)
    back = (rotation.T, -rotation.T @ translation)
    for chain, says in (
        (kalibr(matrices, lenses, (rotation, 1e3 * translation)), "is T in metres"),
        (kalibr(matrices[::-1], lenses[::-1], back), "were left and right exchanged"),
    ):
        with pytest.raises(UserError, match=says):
            calibrate(views, SIZES, GIVEN, read(written(tmp_path / "chain.yaml", chain)))


def test_lenses_for_another_focus_are_the_reason_told(
    calibration_path: Path, tmp_path: Path
) -> None:
    rig = TrueRig.read(calibration_path)
    matrices, lenses, pose = truth(rig)
    refocused = [
        m * np.array([[1.01, 1.0, 1.0], [1.0, 1.01, 1.0], [1.0, 1.0, 1.0]]) for m in matrices
    ]
    given_lenses = read(written(tmp_path / "chain.yaml", kalibr(refocused, lenses, pose)))
    views = take(rig, np.random.default_rng(0), free=2)
    result = calibrate(views, SIZES, GIVEN, given_lenses)
    said = doubts(result, square_error(result))
    assert any("another camera, focus or image size" in text for text in said)
    assert not any("more distortion" in text for text in said)
