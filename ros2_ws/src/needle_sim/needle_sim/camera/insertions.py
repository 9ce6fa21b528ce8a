"""Random insertions, similar to steered ones, and their images, without a ROS graph."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from needle_core.errors import UserError
from needle_sim.camera.image_folder import RenderedPair, truth_of
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import Scenario
from needle_sim.camera.stereo_rig import StereoRig
from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.se3 import FloatArray

CURVATURE = 1.0 / 0.122
"""Curvature of the needle in the phantom [1/m]: the default of sim_rig."""

_STREAM = 10
_CANDIDATES = 256
_BATCHES = 20
_SPACING = 0.001
_WAVES = 3
_WAVE_LENGTHS = (0.025, 0.090)
_WAVE_ANGLES = (0.3, 1.2)
_TURNS_PER_M = 17.0
_LARGEST_PITCH = np.deg2rad(5.0)
# Clearance of the tip from the phantom's faces, and its largest offset to the side [m].
_CLEARANCE = 0.004
_SIDE = 0.025


@dataclasses.dataclass(frozen=True, eq=False)
class RandomPath:
    """Insertion that stays in the phantom, in pieces of 1 mm.

    Attributes
    ----------
    pitch, roll : float
        Pitch and roll of the tip at the entry point [rad].
    rotation : ndarray, shape (N,)
        Rotation of the base over each piece [rad].
    """

    pitch: float
    roll: float
    rotation: FloatArray


def random_path(
    seed: int, depth: float, half_sizes: tuple[float, float], curvature: float
) -> RandomPath:
    """Return a random path with smooth rotations, similar to those of a controller.

    Parameters
    ----------
    seed : int
        Seed of the path.
    depth : float
        Insertion at the end [m].
    half_sizes : pair of float
        Distance from the needle's axis to the phantom's faces, along x and y [m].
    curvature : float
        Curvature of the needle's path [1/m].

    Raises
    ------
    UserError
        If no path stays inside the phantom.
    """
    high, wide = half_sizes[0] - _CLEARANCE, min(_SIDE, half_sizes[1] - _CLEARANCE)
    rng = np.random.default_rng([seed, 0, _STREAM])
    pieces = max(int(np.ceil(depth / _SPACING)), 1)
    at = np.arange(pieces + 1) * _SPACING
    for _ in range(_BATCHES):
        pitch = rng.uniform(-_LARGEST_PITCH, _LARGEST_PITCH, _CANDIDATES)
        roll = rng.uniform(-np.pi, np.pi, _CANDIDATES)
        rate = 2.0 * np.pi * rng.uniform(-_TURNS_PER_M, _TURNS_PER_M, _CANDIDATES)
        length, angle, phase = (
            rng.uniform(*bounds, (_WAVES, _CANDIDATES, 1))
            for bounds in (_WAVE_LENGTHS, _WAVE_ANGLES, (0.0, 2.0 * np.pi))
        )
        turned = rate[:, np.newaxis] * at
        turned = turned + (angle * np.sin(2.0 * np.pi * at / length + phase)).sum(axis=0)
        rotation = np.diff(turned, axis=1)
        poses = [initial_pose(*start) for start in zip(pitch, roll, strict=True)]
        plant = NeedlePlant(np.stack(poses), curvature=curvature)
        inside = np.ones(_CANDIDATES, dtype=bool)
        for piece in range(pieces):
            plant.advance(_SPACING, rotation[:, piece])
            tip = np.abs(plant.T_rig_tip[:, :3, 3])
            inside &= (tip[:, 0] < high) & (tip[:, 1] < wide)
        if inside.any():
            best = int(np.argmax(inside))
            return RandomPath(float(pitch[best]), float(roll[best]), rotation[best])
    raise UserError(f"no random path of {depth * 1e3:g} mm stays inside the phantom")


def render_insertion(
    rig: StereoRig,
    scenario: Scenario,
    *,
    seed: int,
    frames: int,
    depth: float = 0.120,
    step: float = 0.001,
    curvature: float = CURVATURE,
    begin: float = 0.0,
) -> Iterator[RenderedPair]:
    """Render a random insertion; further frames show the stage at rest at its end.

    Parameters
    ----------
    rig : StereoRig
        Cameras and phantom.
    scenario : Scenario
        Disturbances of the images.
    seed : int
        Seed of path and images.
    frames : int
        Number of exposures.
    depth : float
        Insertion at which the stage stops [m].
    step : float
        Insertion between exposures [m].
    curvature : float
        Curvature of the needle's path [1/m].
    begin : float
        Insertion of the first exposure [m].

    Returns
    -------
    iterator of RenderedPair
        The exposures.

    Raises
    ------
    UserError
        If no path of this depth stays inside the phantom.
    """
    path = random_path(seed, depth, (rig.half_height, rig.half_width), curvature)
    renderer = StereoRenderer(rig, seed, scenario=scenario)

    def pairs() -> Iterator[RenderedPair]:
        plant = NeedlePlant(initial_pose(path.pitch, path.roll), curvature=curvature)
        for number in range(frames):
            insertion = min(begin + number * step, depth)
            advance_to(plant, insertion, path.rotation)
            pose, line = plant.T_rig_tip, plant.centreline(_SPACING)
            yield RenderedPair(
                number,
                renderer.render(pose, line, number),
                insertion,
                truth_of(pose) if scenario.needle and insertion > 0.0 else None,
                renderer.visible_share(pose, line, number),
            )

    return pairs()


def advance_to(plant: NeedlePlant, insertion: float, rotation: FloatArray) -> None:
    """Insert a needle along the pieces of a random path.

    Parameters
    ----------
    plant : NeedlePlant
        Single needle on that path.
    insertion : float
        New insertion, not less than the present one [m].
    rotation : ndarray, shape (N,)
        Rotation of the base over each piece, see `RandomPath` [rad].
    """
    while True:
        now = float(plant.insertion)
        piece = min(int(np.floor(now / _SPACING + 1e-9)), len(rotation) - 1)
        length = min((piece + 1) * _SPACING, insertion) - now
        if length <= 1e-12:
            return
        plant.advance(length, rotation[piece] * length / _SPACING)
