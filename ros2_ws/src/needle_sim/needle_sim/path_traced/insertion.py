"""Random insertions of a metal needle, their path-traced images and their ground truth."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator

import numpy as np

from needle_sim.camera.image_folder import RenderedPair, Truth, truth_of
from needle_sim.camera.insertions import CURVATURE, RandomPath, advance_to, random_path
from needle_sim.camera.optics import Optics
from needle_sim.camera.stereo_rig import StereoRig
from needle_sim.needle.needle_shape import NeedleShape
from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.se3 import FloatArray, exp_twist
from needle_sim.path_traced.appearance import Appearance
from needle_sim.path_traced.needle_mesh import NeedleMesh, needle_mesh
from needle_sim.path_traced.renderer import PathTracedRenderer
from needle_sim.path_traced.tracer import MM, Mitsuba

_STREAM = 11
_LARGEST_ANGLE = np.deg2rad(5.0)
_LARGEST_OFFSET = 0.0003
_SPACING = 0.0003
_DISTAL_LENGTH = 0.01
# Length of the shaft in front of the phantom [m].
_OUTSIDE = 0.03


@dataclasses.dataclass(frozen=True, eq=False)
class TracedPair(RenderedPair):
    """Exposure of an insertion of a metal needle.

    Attributes
    ----------
    meshes : pair of NeedleMesh or None
        Needle at the exposures of left and right; the right one may be inserted further.
    """

    meshes: tuple[NeedleMesh, NeedleMesh] | None = None


def trace_insertion(
    mitsuba: Mitsuba,
    rig: StereoRig,
    appearance: Appearance,
    *,
    frames: int,
    depth: float,
    step: float = 0.001,
    begin: float = 0.0,
    curvature: float = CURVATURE,
    empty_first: bool = False,
) -> Iterator[TracedPair]:
    """Render a random insertion; further frames show the stage at rest at its end.

    The needle enters within 0.3 mm of the entry point and within 5 deg of the nominal direction;
    its path is drawn like that of `render_insertion`.

    Parameters
    ----------
    mitsuba : Mitsuba
        Result of `load_mitsuba`.
    rig : StereoRig
        Cameras and phantom.
    appearance : Appearance
        Appearance; its seed determines the path as well.
    frames : int
        Number of exposures.
    depth : float
        Insertion at which the stage stops [m].
    step : float
        Insertion between exposures [m].
    begin : float
        Insertion of the first exposure [m].
    curvature : float
        Curvature of the needle's path [1/m].
    empty_first : bool
        Whether an exposure without the needle precedes the others.

    Returns
    -------
    iterator of TracedPair
        The exposures.

    Raises
    ------
    UserError
        If no path of this depth stays inside the phantom.
    """
    path = random_path(appearance.seed, depth, (rig.half_height, rig.half_width), curvature)
    plant = NeedlePlant(_entry(appearance.seed, path), curvature=curvature)
    optics = [Optics(camera, None) for camera in (rig.left, rig.right)]

    def pairs() -> Iterator[TracedPair]:
        renderer = PathTracedRenderer(mitsuba, rig, appearance)
        insertions = [min(begin + number * step, depth) for number in range(frames)]
        for number, insertion in enumerate([0.0, *insertions] if empty_first else insertions):
            advance_to(plant, insertion, path.rotation)
            truth = meshes = None
            visible = [0.0, 0.0]
            if appearance.needle and insertion > 0.0:
                left = right = _mesh(plant, appearance)
                truth = truth_of(plant.T_rig_tip, _shape(appearance))
                if appearance.lag > 0.0:
                    later = copy.deepcopy(plant)
                    advance_to(later, min(insertion + appearance.lag, depth), path.rotation)
                    right = _mesh(later, appearance)
                meshes = left, right
                distal = [mesh.line[-int(_DISTAL_LENGTH / _SPACING) :] for mesh in meshes]
                visible = [
                    float(camera.in_image(camera.project(points)).mean())
                    for camera, points in zip(optics, distal, strict=True)
                ]
            images = renderer.render(meshes, number)
            more = _truth_values(appearance, truth, meshes)
            yield TracedPair(
                number, images, insertion, truth, (visible[0], visible[1]), more, meshes
            )

    return pairs()


def _entry(seed: int, path: RandomPath) -> FloatArray:
    """Return a random pose of the tip at the entry, shape (4, 4) [m].

    The yaw rotates the whole path about rig's x axis, so that its depth does not change.
    """
    rng = np.random.default_rng([seed, 0, _STREAM])
    around, away = rng.uniform(0.0, 2.0 * np.pi), _LARGEST_OFFSET * np.sqrt(rng.uniform())
    largest = np.sqrt(max(_LARGEST_ANGLE**2 - path.pitch**2, 0.0))
    aside = exp_twist([0.0, 0.0, 0.0, rng.uniform(-largest, largest), 0.0, 0.0])
    pose = aside @ initial_pose(path.pitch, path.roll)
    pose[:2, 3] += away * np.array([np.cos(around), np.sin(around)])
    return np.asarray(pose)


def _shape(appearance: Appearance) -> NeedleShape:
    """Return the shape of the needle, with or without a bend."""
    # Half of the bend tilts the end to one side of the path, the other half the shaft.
    return NeedleShape(
        diameter=appearance.diameter, bend_angle=2.0 * appearance.lean, lean=appearance.lean
    )


def _mesh(plant: NeedlePlant, appearance: Appearance) -> NeedleMesh:
    # The needle bends towards its sharp side.
    return needle_mesh(_middle_line(plant, appearance), -plant.T_rig_tip[:3, 1], appearance)


def _middle_line(plant: NeedlePlant, appearance: Appearance) -> FloatArray:
    """Return the needle's centreline, including the part outside, (M, 3) [m]."""
    line = plant.centreline(_SPACING)
    if appearance.lean > 0.0:
        line = _shape(appearance).shaft_centreline(plant.T_rig_tip, line, _SPACING)
    back = line[0] - line[1]
    back /= np.linalg.norm(back)
    before = np.arange(int(_OUTSIDE / _SPACING), 0, -1)[:, np.newaxis] * _SPACING
    return np.concatenate([line[0] + before * back, line])


TRUTH_COLUMNS = (
    *("axis_x_mm", "axis_y_mm", "axis_z_mm", "extreme_x_mm", "extreme_y_mm", "extreme_z_mm"),
    *("face_x_mm", "face_y_mm", "face_z_mm", "heading_x", "heading_y", "heading_z"),
    *("bevel_length_mm", "diameter_mm", "light", "bottom", "needle", "bubbles"),
)
"""Columns: end of the axis (the tip), foremost point of the metal, centre of the bevel, ..."""


def _truth_values(
    appearance: Appearance, truth: Truth | None, meshes: tuple[NeedleMesh, NeedleMesh] | None
) -> list[float | str]:
    """Return the values of `TRUTH_COLUMNS`; empty without a needle."""
    metal = "" if truth is None else appearance.metal
    scene = (appearance.lamps, appearance.floor, metal, appearance.bubbles)
    if truth is None or meshes is None:
        return [*[""] * 14, *scene]
    heading = (
        np.sin(truth.pitch),
        -np.cos(truth.pitch) * np.sin(truth.yaw),
        np.cos(truth.pitch) * np.cos(truth.yaw),
    )
    places = np.concatenate([truth.tip, meshes[0].extreme, meshes[0].face_middle])
    values = [*places * MM, *heading, appearance.bevel_length * MM, appearance.diameter * MM]
    return [*(round(float(value), 6) for value in values), *scene]
