"""The shipped rig."""

from __future__ import annotations

import pytest

from needle_sim.camera.stereo_rig import StereoRig, load_stereo_rig

from .scenes import CALIBRATION


@pytest.fixture(scope="session")
def rig() -> StereoRig:
    return load_stereo_rig(CALIBRATION)
