"""Size and camera matrix of images that show a part of the sensor, or are binned (REP 104)."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, RegionOfInterest

from needle_tracker.answers.tracker_messages import camera_info_problem, image_geometry
from needle_tracker.optics.calibration import Camera, StereoCalibration

# Full sensor: width, height [px] and K.
SENSOR = (2048, 1536)
K = np.array([[4000.0, 3.0, 1030.0], [0.0, 4020.0, 765.0], [0.0, 0.0, 1.0]])

CASES: list[tuple[dict[str, Any], tuple[int, int]]] = [
    ({}, (2048, 1536)),
    ({"binning_x": 1, "binning_y": 1}, (2048, 1536)),
    ({"roi": (0, 0, 2048, 1536)}, (2048, 1536)),
    ({"binning_x": 2, "binning_y": 2}, (1024, 768)),
    ({"binning_x": 4, "binning_y": 2}, (512, 768)),
    ({"binning_y": 2}, (2048, 768)),
    ({"binning_x": 3}, (682, 1536)),
    ({"roi": (512, 384, 1024, 768)}, (1024, 768)),
    ({"roi": (512, 384, 1024, 768), "binning_x": 2, "binning_y": 2}, (512, 384)),
    ({"roi": (100, 0, 1900, 0), "binning_x": 2}, (950, 1536)),
]


def info(fields: dict[str, Any]) -> CameraInfo:
    """Return the message of the sensor, with an roi (x, y, width, height) and binning."""
    x, y, width, height = fields.get("roi", (0, 0, 0, 0))
    return CameraInfo(
        width=SENSOR[0],
        height=SENSOR[1],
        k=K.ravel(),
        roi=RegionOfInterest(x_offset=x, y_offset=y, width=width, height=height),
        **{name: value for name, value in fields.items() if name != "roi"},
    )


def camera(like: Camera, size: tuple[int, int], matrix: np.ndarray) -> Camera:
    return dataclasses.replace(like, width=size[0], height=size[1], camera_matrix=matrix)


@pytest.mark.parametrize(("fields", "size"), CASES)
def test_a_ray_falls_where_the_image_shows_it(
    calibration: StereoCalibration, fields: dict[str, Any], size: tuple[int, int]
) -> None:
    width, height, matrix = image_geometry(info(fields))
    assert (width, height) == size
    ray = np.array([0.05, -0.03, 1.0])
    x, y, *_ = fields.get("roi", (0, 0, 0, 0))
    bins = np.array([fields.get("binning_x") or 1, fields.get("binning_y") or 1])
    np.testing.assert_allclose((matrix @ ray)[:2], ((K @ ray)[:2] - [x, y]) / bins)
    assert matrix[2] == pytest.approx([0.0, 0.0, 1.0])
    calibrated = camera(calibration.left, size, matrix)
    assert camera_info_problem(info(fields), "left", calibrated) == ("", False)
    off = matrix + np.array([[0.0, 0.0, 0.6], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    calibrated = camera(calibration.left, size, off)
    wanted = "left camera_info differs from the calibration by 0.6 px"
    assert camera_info_problem(info(fields), "left", calibrated) == (wanted, False)


def test_sizes_that_do_not_fit_are_told_with_their_origin(calibration: StereoCalibration) -> None:
    calibrated = camera(calibration.left, (1024, 768), K)
    fields = {"roi": (512, 384, 1024, 768), "binning_x": 2, "binning_y": 2}
    wanted = (
        "left camera_info is for 512x384 (sensor 2048x1536, roi 1024x768 at 512,384, binning 2x2), "
        "the calibration for 1024x768"
    )
    assert camera_info_problem(info(fields), "left", calibrated) == (wanted, True)
    wanted = "left camera_info is for 2048x1536, the calibration for 1024x768"
    assert camera_info_problem(info({}), "left", calibrated) == (wanted, True)


def test_a_message_is_not_changed_and_without_k_only_its_size_counts(
    calibration: StereoCalibration,
) -> None:
    message = info({"binning_x": 2, "binning_y": 2})
    image_geometry(message)
    np.testing.assert_array_equal(message.k, K.ravel())
    message.k = np.zeros(9)
    message.roi.x_offset = 7
    calibrated = camera(calibration.left, (1024, 768), K)
    assert camera_info_problem(message, "left", calibrated) == ("", False)
