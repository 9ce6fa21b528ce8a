"""Simulated insertions without rotation, and the curvature estimated from them ([KC09] IV-B)."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from needle_controller.curvature.curvature_fit import circle_curvature, fit_curvature

Floats = npt.NDArray[np.float64]

RADIUS = 0.122
"""1 / kappa of the paper's needle [m]."""
NOISE = 1e-3
"""Largest error of a measured coordinate in the paper [m]."""
ARC = 0.06
"""Length of an insertion [m]; a tip is measured every mm."""
HEADING_STD = math.radians(5.0)
ENTRY_STD = 0.5e-3


@dataclasses.dataclass(frozen=True)
class CurvatureErrors:
    """Relative errors of the curvature over many insertions.

    Attributes
    ----------
    bias, spread : float
        Mean and standard deviation of the error of 1 / kappa from the most likely arc.
    circle_bias, circle_spread : float
        The same for kappa from a plain least-squares circle.
    """

    bias: float
    spread: float
    circle_bias: float
    circle_spread: float


def curvature_errors(count: int, rng: np.random.Generator) -> CurvatureErrors:
    """Return the errors of the curvature over a number of insertions."""
    tips, insertion = pure_insertions(count, rng)
    radius = fit_curvature(tips, insertion).radius / RADIUS - 1.0
    circle = circle_curvature(tips) * RADIUS - 1.0
    return CurvatureErrors(
        float(np.mean(radius)), float(np.std(radius)), float(np.mean(circle)), float(np.std(circle))
    )


def pure_insertions(count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return measured tips of insertions without rotation, and the insertion depths.

    Returns
    -------
    tips : ndarray, shape (count, 61, 3)
        Tips on circles of radius `RADIUS` with random roll, a heading error of 5 deg and an entry
        error of 0.5 mm (standard deviations), with +-1 mm of uniform noise [m].
    insertion : ndarray, shape (61,)
        Insertion depths [m].
    """
    insertion = np.linspace(0.0, ARC, 61)
    angle = insertion / RADIUS
    circle = RADIUS * np.stack([np.zeros(61), np.cos(angle) - 1.0, np.sin(angle)], axis=-1)
    rolls = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi, (count, 1)))
    heading = np.zeros((count, 3))
    heading[:, :2] = rng.normal(0.0, HEADING_STD, (count, 2))
    turned = (Rotation.from_rotvec(heading) * rolls).as_matrix()
    tips = circle @ np.swapaxes(turned, -1, -2)
    tips += rng.normal(0.0, ENTRY_STD, (count, 1, 3))
    return tips + rng.uniform(-NOISE, NOISE, tips.shape), insertion
