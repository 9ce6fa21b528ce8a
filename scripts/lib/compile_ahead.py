"""Compile the numerical code of nodes and studies, so that a first run need not wait.

`scripts/setup` runs this after a build, one process for each part. Nodes that find nothing compiled
(other sources, another machine) do it themselves when they start.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from needle_bringup.studies.study_controllers import controller_factory
from needle_controller.presets.steering_settings import PAPER_NOISE, PRESETS, SteeringSettings
from needle_controller.protocol.plane_control import PlaneControl
from needle_sim.camera.insertions import render_insertion
from needle_sim.camera.scenarios import CLEAN
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.studies.disturbances import Disturbances
from needle_sim.studies.study import StudySettings, run_study
from needle_tracker.filter.needle_tracker import NeedleTracker
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.tracker_parameters import StereoTrackerParameters

CALIBRATION = (
    Path(__file__).resolve().parents[2] / "ros2_ws/src/needle_tracker/config/calibration.yaml"
)


def controllers() -> None:
    """Compile each preset as used in the node and in a study."""
    for preset in PRESETS:
        PlaneControl(SteeringSettings(preset=preset, target_offset=0.003, **PAPER_NOISE))
        settings = StudySettings(
            curvature=SteeringSettings.curvature,
            depth=0.003,
            step_length=SteeringSettings.step_length,
            disturbances=Disturbances(),
            seed=0,
        )
        run_study(np.zeros((2, 3)), controller_factory(preset, 0.001), settings)


def tracker() -> None:
    """Compile the acquisition and tracking of a needle."""
    calibration = load_calibration(CALIBRATION)
    settings = StereoTrackerParameters()
    rig = load_stereo_rig(CALIBRATION)
    for known in (True, False):
        stereo = NeedleTracker(calibration, settings)
        stereo.warm_up()
        for pair in render_insertion(rig, CLEAN, seed=1, frames=14):
            stereo.process(*pair.images, pair.insertion if known else None)


PARTS: dict[str, Callable[[], None]] = {"controllers": controllers, "tracker": tracker}

if __name__ == "__main__":
    PARTS[sys.argv[1]]()
