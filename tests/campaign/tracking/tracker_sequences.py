"""Rendered insertions with known truth, to measure the tracker on."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import find_scenario
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.needle.plant import NeedlePlant, initial_pose

STEP = 1e-3
FIRST_STEP = 6
SPACING = 5e-4
CURVATURE = 8.2
# How far the steered needle may stray, in a control loop's place: the bevel is turned back.
_STRAY = 4e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Exposure:
    """One stereo pair and what it shows.

    Attributes
    ----------
    insertion : float
        Length of needle in the phantom [m].
    T_rig_tip : ndarray, shape (4, 4)
        The tip's true pose.
    left, right : ndarray of uint8, shape (height, width)
        The images.
    seen : pair of float
        Share of the last 10 mm that the left and the right camera see.
    """

    insertion: float
    T_rig_tip: NDArray[np.float64]
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    seen: tuple[float, float]


def insertion_sequence(
    calibration: Path, scenario: str, seed: int, steps: int, noise: float | None = None
) -> Iterator[Exposure]:
    """Yield one exposure for each millimetre of a simulated insertion.

    The bevel is turned at random, from held to spun, and away from where the needle strays to.

    Parameters
    ----------
    calibration : Path
        The rig's calibration file.
    scenario : str
        One of the renderer's.
    seed : int
        Of the renderer, the start and the steering; not negative.
    steps : int
        How many exposures, from 6 mm of insertion on.
    noise : float, optional
        Standard deviation of the sensor's noise, in place of the scenario's [grey levels].
    """
    trouble = find_scenario(scenario)
    if noise is not None:
        trouble = dataclasses.replace(trouble, noise=noise)
    renderer = StereoRenderer(load_stereo_rig(calibration), seed, scenario=trouble)
    rng = np.random.default_rng([seed, 41])
    pitch, roll = rng.uniform(-1.0, 1.0, 2) * (math.radians(5.0), math.pi)
    plant = NeedlePlant(initial_pose(float(pitch), float(roll)), curvature=CURVATURE)
    turn = 0.0
    for number in range(FIRST_STEP + steps):
        if number % 8 == 0:
            turn = float(rng.choice([0.0, 0.02, 0.06, 0.3]) * rng.choice([-1.0, 1.0]))
            turn += _turn_back(np.asarray(plant.T_rig_tip), 8)
        plant.advance(STEP, turn)
        if number < FIRST_STEP:
            continue
        pose = np.asarray(plant.T_rig_tip)
        path = plant.centreline(SPACING)
        left, right = renderer.render(pose, path, number)
        seen = renderer.visible_share(pose, path, number)
        yield Exposure(STEP * (number + 1), pose, left, right, seen)


def _turn_back(pose: NDArray[np.float64], steps: int) -> float:
    """Return the rotation per step that turns the bending towards the axis, 0 while near it."""
    sideways = pose[:2, 3] + 0.02 * pose[:2, 2]
    if float(np.hypot(*sideways)) < _STRAY:
        return 0.0
    # The needle bends towards -y of its own frame.
    wanted = pose[:3, :3].T @ np.array([-sideways[0], -sideways[1], 0.0])
    return math.remainder(math.atan2(wanted[0], -wanted[1]), 2.0 * math.pi) / steps
