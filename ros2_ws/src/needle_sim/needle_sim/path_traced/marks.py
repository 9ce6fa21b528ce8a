"""Marks that are drawn, not traced: lint, dust, earlier needle paths, edges of a clear box."""

from __future__ import annotations

import numpy as np

from needle_sim.camera.insertions import CURVATURE, advance_to, random_path
from needle_sim.camera.optics import FloatImage, Optics
from needle_sim.camera.stroke import stroke
from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.se3 import FloatArray
from needle_sim.path_traced.world import LENGTH, World, block_bounds, is_box

_STREAM = 32
_SPACING = 0.0004
# Range of lint along the needle, and its clearance from the phantom's faces [m].
_LENGTHS = (0.004, 0.14)
_CLEARANCE = 0.001
_FIBRE_LENGTHS = (0.0005, 0.007)
_FIBRE_DIAMETERS = (0.00003, 0.00012)
_DUST_SHARE = 0.5
_DUST_LENGTH = 0.0001
_DUST_DIAMETERS = (0.00008, 0.0003)
_LINT_BLUR_PX = 0.4
_TRACK_DIAMETERS = (0.0003, 0.0009)
_TRACK_DEPTHS = (0.03, 0.12)
_TRACK_ASIDE = 0.01
# Length over which the clouding of a track varies and fades out at its end [m].
_CLOUD_LENGTH = 0.005
# Blur of a track's edge [px].
_TRACK_BLUR_PX = 1.5


class Marks:
    """Lint, earlier paths and edges of a phantom, identical for both cameras.

    Parameters
    ----------
    world : World
        Static parts of the sequence.
    """

    def __init__(self, world: World) -> None:
        appearance = world.appearance
        rng = np.random.default_rng([appearance.seed, 0, _STREAM])
        self._lines: list[tuple[FloatArray, float, FloatArray, float]] = []
        for _ in range(appearance.tracks):
            self._add_track(rng, world)
        for _ in range(appearance.lint):
            self._add_lint(rng, world)
        if is_box(world.rig):
            self._add_edges(rng, world)

    def draw(self, image: FloatImage, optics: Optics, white: float) -> None:
        """Draw the marks over an image of the floor.

        Parameters
        ----------
        image : ndarray of float32
            Radiance, modified in place.
        optics : Optics
            Optics of the camera.
        white : float
            Radiance of light lint and of clouded gel [unit of the image].
        """
        for line, diameter, grey, blur in self._lines:
            drawn = stroke(
                optics.project(line),
                optics.radius_px(line, diameter / 2.0),
                blur,
                optics.image_size,
            )
            pixels = (drawn.row, drawn.column)
            strength = np.abs(grey)[drawn.sample]
            colour = np.where(grey[drawn.sample] > 0.0, white, 0.0)
            image[pixels] += drawn.coverage * strength * (colour - image[pixels])

    def _add_lint(self, rng: np.random.Generator, world: World) -> None:
        """Add a randomly bent and rotated fibre, or a speck; light or dark."""
        low, high = np.transpose([*block_bounds(world.rig, world.appearance), _LENGTHS])
        middle = rng.uniform(low + _CLEARANCE, high - _CLEARANCE)
        is_dust = rng.random() < _DUST_SHARE
        length = _DUST_LENGTH if is_dust else rng.uniform(*_FIBRE_LENGTHS)
        diameter = rng.uniform(*(_DUST_DIAMETERS if is_dust else _FIBRE_DIAMETERS))
        count = max(int(length / _SPACING), 2) + 1
        at = np.linspace(-0.5, 0.5, count)[:, np.newaxis]
        along, bent = rng.standard_normal((2, 3)) * [0.3, 1.0, 1.0]
        along /= np.linalg.norm(along)
        line = middle + length * (at * along + 0.5 * (at * at) * bent)
        strength = rng.uniform(0.3, 1.0) * rng.choice([-1.0, 1.0])
        self._lines.append((line, float(diameter), np.full(count, strength), _LINT_BLUR_PX))

    def _add_edges(self, rng: np.random.Generator, world: World) -> None:
        """Add the four glued edges of the box along the needle."""
        z = np.arange(0.0, LENGTH, _SPACING)
        (_, x), (_, y) = block_bounds(world.rig, world.appearance)
        for up, aside in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):
            line = np.stack([np.full_like(z, up * x), np.full_like(z, aside * y), z], axis=1)
            strength = rng.uniform(0.2, 0.8) * rng.choice([-1.0, 1.0])
            diameter = world.wall * float(rng.uniform(0.1, 1.0))
            self._lines.append((line, diameter, np.full(len(z), strength), _TRACK_BLUR_PX))

    def _add_track(self, rng: np.random.Generator, world: World) -> None:
        """Add the path of an earlier needle: torn, unevenly clouded gel."""
        depth, rig = rng.uniform(*_TRACK_DEPTHS), world.rig
        path = random_path(
            int(rng.integers(2**31)), depth, (rig.half_height, rig.half_width), CURVATURE
        )
        plant = NeedlePlant(initial_pose(path.pitch, path.roll), curvature=CURVATURE)
        advance_to(plant, depth, path.rotation)
        line = plant.centreline(_SPACING)
        line[:, 1] += rng.uniform(-_TRACK_ASIDE, _TRACK_ASIDE)
        smooth = np.hanning(round(2.0 * _CLOUD_LENGTH / _SPACING))
        cloud = np.convolve(rng.standard_normal(len(line)), smooth / np.linalg.norm(smooth), "same")
        strength = (
            rng.uniform(0.2, 1.0)
            * world.appearance.track_strength
            * np.clip(1.0 + 0.6 * cloud, 0.0, 2.5)
        )
        left = np.arange(len(line))[::-1] * _SPACING
        strength *= np.clip(left / _CLOUD_LENGTH, 0.0, 1.0)
        sign = 1.0 if rng.random() < 0.7 else -1.0
        diameter = float(rng.uniform(*_TRACK_DIAMETERS))
        self._lines.append((line, diameter, sign * strength, _TRACK_BLUR_PX))
