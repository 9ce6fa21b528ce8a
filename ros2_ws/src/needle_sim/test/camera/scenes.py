"""Needles to render, and their effect on an image."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import CLEAN
from needle_sim.camera.stereo_rig import SimulatedCamera, StereoRig
from needle_sim.needle.plant import NeedlePlant, initial_pose

CALIBRATION = Path(__file__).parents[3] / "needle_tracker" / "config" / "calibration.yaml"
TOP_AND_SIDE = CALIBRATION.with_name("calibration_top_and_side.yaml")
CURVATURE = 1.0 / 0.122
STILL = dataclasses.replace(CLEAN, noise=0.0)
Pair = tuple[np.ndarray, np.ndarray]


def small(rig: StereoRig) -> StereoRig:
    """Return the rig with images of a quarter of the sides."""

    def smaller(camera: SimulatedCamera) -> SimulatedCamera:
        matrix = camera.camera_matrix.copy()
        matrix[:2] /= 4.0
        width, height = camera.image_width // 4, camera.image_height // 4
        return dataclasses.replace(
            camera, image_width=width, image_height=height, camera_matrix=matrix
        )

    return dataclasses.replace(rig, left=smaller(rig.left), right=smaller(rig.right))


def needle(
    length: float, pitch_deg: float = 2.0, roll_deg: float = 15.0, curvature: float = CURVATURE
) -> NeedlePlant:
    plant = NeedlePlant(initial_pose(*np.deg2rad([pitch_deg, roll_deg])), curvature=curvature)
    plant.advance(length, 0.0)
    return plant


def render(renderer: StereoRenderer, plant: NeedlePlant | None, number: int) -> Pair:
    if plant is None:
        return renderer.render(np.eye(4), np.zeros((1, 3)), number)
    return renderer.render(plant.T_rig_tip, plant.centreline(0.001), number)


def taken(with_it: Pair, without: Pair) -> np.ndarray:
    """Return the darkening of both images by something; the same exposure has the same noise."""
    return np.asarray(np.stack(without).astype(float) - np.stack(with_it))


def darkness(renderer: StereoRenderer, plant: NeedlePlant) -> np.ndarray:
    """Return the darkening of each image by the needle, the mean of some exposures."""
    pairs = [taken(render(renderer, plant, n), render(renderer, None, n)) for n in range(2)]
    return np.asarray(np.mean(pairs, axis=0))
