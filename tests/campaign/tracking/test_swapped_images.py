"""Swapped images are suspected, correct ones are not: needles rendered in all scenes."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import find_scenario
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_tracker.answers.pair_answers import SwapWatch
from needle_tracker.filter.measurement import Measurement
from needle_tracker.filter.needle_tracker import NeedleTracker
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.tracker_parameters import StereoTrackerParameters

Pair = tuple[float, np.ndarray, np.ndarray]


@functools.lru_cache(maxsize=1)
def pairs(path: Path, scenario: str, seed: int, last_mm: int = 40) -> list[Pair]:
    """Render image pairs; cached, because tests of one scenario follow each other."""
    return list(drawn(path, scenario, seed, last_mm))


def drawn(path: Path, scenario: str, seed: int, last_mm: int) -> Iterator[Pair]:
    renderer = StereoRenderer(load_stereo_rig(path), seed, scenario=find_scenario(scenario))
    plant = NeedlePlant(initial_pose(math.radians(1.0 + seed), 0.5 * seed), curvature=8.2)
    for mm in range(1, last_mm + 1):
        plant.advance(1e-3, 0.06)
        if mm >= 4:
            pose = np.asarray(plant.T_rig_tip)
            yield 1e-3 * mm, *renderer.render(pose, plant.centreline(5e-4), mm)


class SwapBench:
    """A tracker and the detector of swapped images."""

    def __init__(self, calibration: StereoCalibration) -> None:
        settings = StereoTrackerParameters()
        self.tracker = NeedleTracker(calibration, settings)
        self.watch = SwapWatch(calibration, settings)
        self.ever = False

    def update(self, left: np.ndarray, right: np.ndarray, insertion: float | None) -> Measurement:
        measured = self.tracker.process(left, right, insertion)
        self.watch.update(left, right, insertion, measured)
        self.ever = self.ever or self.watch.suspected
        return measured


@pytest.fixture
def bench(calibration: StereoCalibration) -> SwapBench:
    return SwapBench(calibration)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("scenario", ["clean", "clutter", "defocus"])
def test_swapped_images_are_suspected(
    bench: SwapBench, calibration_path: Path, scenario: str, known: bool
) -> None:
    for insertion, left, right in pairs(calibration_path, scenario, 1):
        bench.update(right, left, insertion if known else None)
    assert bench.watch.suspected


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(
    "scenario", ["clean", "clutter", "heavy_clutter", "occlusion", "absent", "defocus"]
)
def test_correct_images_are_not_suspected(
    bench: SwapBench, calibration_path: Path, scenario: str, known: bool
) -> None:
    for insertion, left, right in pairs(calibration_path, scenario, 2, 60):
        bench.update(left, right, insertion if known else None)
    assert not bench.ever
