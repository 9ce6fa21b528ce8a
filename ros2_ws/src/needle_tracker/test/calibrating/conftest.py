"""Rigs with known parameters, their views of boards, and their calibrations, computed once."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_sim.camera.stereo_rig import StereoRig, load_stereo_rig
from needle_tracker.calibrating.calibration_session import BoardView
from needle_tracker.calibrating.rig_calibration import RigCalibration, calibrate
from synthetic_rig import GIVEN, GIVEN_BOX, SIZES, take, take_in_box


@pytest.fixture(scope="session")
def rig(calibration_path: Path) -> StereoRig:
    return load_stereo_rig(calibration_path)


@pytest.fixture(scope="session")
def views(rig: StereoRig) -> list[BoardView]:
    return take(rig)


@pytest.fixture(scope="session")
def result(views: list[BoardView]) -> RigCalibration:
    return calibrate(views, SIZES, GIVEN)


@pytest.fixture(scope="session")
def box_path(calibration_path: Path) -> Path:
    return calibration_path.with_name("calibration_top_and_side.yaml")


@pytest.fixture(scope="session")
def box_rig(box_path: Path) -> StereoRig:
    return load_stereo_rig(box_path)


@pytest.fixture(scope="session")
def box_views(box_rig: StereoRig) -> list[BoardView]:
    return take_in_box(box_rig)


@pytest.fixture(scope="session")
def box_result(box_views: list[BoardView]) -> RigCalibration:
    return calibrate(box_views, SIZES, GIVEN_BOX)
