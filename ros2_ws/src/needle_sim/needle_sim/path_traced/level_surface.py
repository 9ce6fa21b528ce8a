"""The one kind of rig that is path-traced: both cameras look through one level surface."""

from __future__ import annotations

import numpy as np

from needle_common.errors import UserError
from needle_sim.camera.stereo_rig import StereoRig

_UP = np.array([1.0, 0.0, 0.0])


def check_level(rig: StereoRig) -> None:
    """Raise a `UserError` where there are other windows than one level surface without layers."""
    left, right = rig.left.window, rig.right.window
    alike = left.outer == right.outer and left.indices == right.indices
    level = np.array_equal(left.normal, _UP) and np.array_equal(right.normal, _UP)
    if not (alike and level and not left.thicknesses):
        raise UserError(
            "renderer path_traced knows one level surface without layers, not windows: give a "
            "calibration with `phantom`"
        )


def refractive_index(rig: StereoRig) -> float:
    """Return the phantom's refractive index [-]."""
    return rig.left.window.indices[-1]
