"""Columns of truth.csv for a path-traced needle, beside its tip: its bevel and appearance."""

from __future__ import annotations

import numpy as np

from needle_sim.path_traced.appearance import Appearance
from needle_sim.path_traced.insertion import TracedPair
from needle_sim.path_traced.needle_mesh import NeedleEnd
from needle_sim.path_traced.tracer import MM

TRUTH_COLUMNS = (
    *("axis_x_mm", "axis_y_mm", "axis_z_mm", "extreme_x_mm", "extreme_y_mm", "extreme_z_mm"),
    *("face_x_mm", "face_y_mm", "face_z_mm", "heading_x", "heading_y", "heading_z"),
    *("bevel_length_mm", "diameter_mm", "light", "bottom", "needle", "bubbles"),
)
"""The axis's end is the tip; then the metal's extreme point, the face's middle, the heading."""


def truth_values(look: Appearance, pair: TracedPair) -> list[float | str]:
    """Return the values of `TRUTH_COLUMNS`; empty where there is no needle."""
    scene: list[float | str] = [look.lamps, look.floor, look.metal, look.bubbles]
    if pair.truth is None or pair.meshes is None:
        return [*[""] * 14, look.lamps, look.floor, "", look.bubbles]
    truth = pair.truth
    heading = (
        np.sin(truth.pitch),
        -np.cos(truth.pitch) * np.sin(truth.yaw),
        np.cos(truth.pitch) * np.cos(truth.yaw),
    )
    end = NeedleEnd(look.diameter, look.bevel_angle, look.hollow)
    places = np.concatenate([truth.tip, pair.meshes[0].extreme, pair.meshes[0].face_middle])
    values = [*places * MM, *heading, end.bevel_length * MM, end.diameter * MM]
    return [*(round(float(value), 6) for value in values), *scene]
