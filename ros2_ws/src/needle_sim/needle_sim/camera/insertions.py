"""Random insertions as a steered needle makes them, and their images, without any graph."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from needle_core.errors import UserError
from needle_sim.camera.image_folder import Truth, truth_of
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import Scenario
from needle_sim.camera.stereo_rig import StereoRig
from needle_sim.camera.view import GreyImage
from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.se3 import FloatArray

CURVATURE = 1.0 / 0.122
"""Of the needle in the phantom [1/m], as sim_rig has it by default."""

_STREAM = 10
_CANDIDATES = 256
_BATCHES = 20
_SPACING = 0.001
_WAVES = 3
_WAVE_LENGTHS = (0.025, 0.090)
_WAVE_ANGLES = (0.3, 1.2)
_TURNS_PER_M = 17.0
_LARGEST_PITCH = np.deg2rad(5.0)
# How far the tip keeps from the phantom's faces, and from the sides of the cameras' view [m].
_CLEARANCE = 0.004
_SIDE = 0.025


@dataclasses.dataclass(frozen=True, eq=False)
class RandomPath:
    """An insertion that stays in the phantom, by 1 mm.

    Attributes
    ----------
    pitch, roll : float
        Of the tip at the entry point [rad].
    rotation : ndarray, shape (N,)
        Of the base, over each of the path's pieces [rad].
    """

    pitch: float
    roll: float
    rotation: FloatArray


@dataclasses.dataclass(frozen=True, eq=False)
class RenderedPair:
    """One exposure of an insertion.

    Attributes
    ----------
    number : int
        Of the exposure.
    images : pair of ndarray of uint8
        Left and right.
    insertion : float
        What the stage says [m].
    truth : Truth or None
        None where there is no needle in the phantom.
    visible_share : pair of float
        Of the needle's last 10 mm, by the left and the right camera.
    """

    number: int
    images: tuple[GreyImage, GreyImage]
    insertion: float
    truth: Truth | None
    visible_share: tuple[float, float]


def random_path(
    seed: int, depth: float, half_sizes: tuple[float, float], curvature: float
) -> RandomPath:
    """Return a random path with smooth rotations, as a controller turns the needle.

    Parameters
    ----------
    seed : int
        Same seed, same path.
    depth : float
        How far the needle goes in [m].
    half_sizes : pair of float
        How far the phantom reaches from the needle's axis, along x and y [m].
    curvature : float
        Of the needle's path [1/m].

    Raises
    ------
    UserError
        If no such path was found.
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
    """Render a random insertion; the stage rests at its end if more frames are wanted.

    Parameters
    ----------
    rig : StereoRig
        Cameras and phantom.
    scenario : Scenario
        What troubles the cameras.
    seed : int
        Keys path and images.
    frames : int
        How many exposures.
    depth : float
        Where the stage stops [m].
    step : float
        Insertion from one exposure to the next [m].
    curvature : float
        Of the needle's path [1/m].
    begin : float
        Insertion of the first exposure [m].

    Returns
    -------
    iterator of RenderedPair
        One exposure after the other.

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
    """Push a needle along a random path's pieces.

    Parameters
    ----------
    plant : NeedlePlant
        A single needle on that path.
    insertion : float
        How far in it is to be, at least as far as it is [m].
    rotation : ndarray, shape (N,)
        Of the base over each piece, as `RandomPath` has it [rad].
    """
    while True:
        now = float(plant.insertion)
        piece = min(int(np.floor(now / _SPACING + 1e-9)), len(rotation) - 1)
        length = min((piece + 1) * _SPACING, insertion) - now
        if length <= 1e-12:
            return
        plant.advance(length, rotation[piece] * length / _SPACING)
