"""An estimator of another package: tried when it is loaded, and never believed unseen."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt

from needle_controller.model.arc_motion import arc
from needle_controller.model.arrays import Array
from needle_controller.observers.estimator import Estimate
from needle_controller.presets.own_parts import OwnPart, own_part
from needle_controller.presets.steering_settings import SteeringSettings

_TRIED_STEPS, _STEP = 20, 0.001
_NEAR = 0.005
"""Farther from an exact tip than this, after all these steps, is no estimate [m]."""
_FRAME_TOLERANCE = 1e-4


class OwnEstimator:
    """An own estimator as the rest knows one; see `estimator.Estimator`.

    What it raises, and what it says that cannot be, is an `OwnPartError` that names it.

    Parameters
    ----------
    part : OwnPart
        Which.
    settings : SteeringSettings
        Of the controller.
    initial_rotation : array_like, shape (3, 3)
        Orientation of a needle at its entry with the base's rotation at 0, in `target_plane`.
    entry : array_like, shape (3,), optional
        Where it enters, in `target_plane` [m]; not known if none is given.
    rng : numpy.random.Generator
        All chance that the estimator may use.
    """

    def __init__(
        self,
        part: OwnPart,
        settings: SteeringSettings,
        initial_rotation: npt.ArrayLike,
        entry: npt.ArrayLike | None,
        rng: np.random.Generator,
    ) -> None:
        self._part = part
        turn = np.array(initial_rotation, dtype=float)
        place = None if entry is None else np.array(entry, dtype=float)
        with part.blamed(f"{part.made_by.__name__}(settings, initial_rotation, entry, rng)"):
            self._own = part.made_by(settings, turn, place, rng)

    def reset(self, tip: npt.ArrayLike, joints: npt.ArrayLike) -> None:
        """Start over at a first measurement; see `Estimator.reset`."""
        with self._part.blamed("reset"):
            self._own.reset(np.array(tip, dtype=float), np.array(joints, dtype=float))

    def advance(self, d_insertion: float, d_rotation: float) -> None:
        """Move on by what really happened; see `Estimator.advance`."""
        with self._part.blamed("advance"):
            self._own.advance(float(d_insertion), float(d_rotation))

    def correct(
        self, tip: npt.ArrayLike, covariance: npt.ArrayLike | None = None, age: float = 0.0
    ) -> None:
        """Take a measurement; see `Estimator.correct`."""
        known = None if covariance is None else np.array(covariance, dtype=float)
        with self._part.blamed("correct"):
            self._own.correct(np.array(tip, dtype=float), known, float(age))

    def estimate(self) -> Estimate:
        """Return what is known now; see `Estimator.estimate`."""
        part = self._part
        with part.blamed("estimate"):
            said = self._own.estimate()
        if not isinstance(said, Estimate):
            raise part.error(
                f"estimate() returned {type(said).__name__}, wants an Estimate "
                "(needle_controller.observers.estimator.pose_estimate makes one)"
            )
        checked = part.checked
        checked(
            "estimate().coordinates",
            said.coordinates,
            (6,),
            "numbers x, y, z [m], yaw, pitch, roll [rad]",
        )
        checked("estimate().linearized", said.linearized, (3,), "numbers s1, s2, s3 of (6)")
        checked("estimate().curvature", said.curvature, (), "curvature [1/m]")
        meaning = "the covariance of the coordinates, in their order"
        checked("estimate().covariance", said.covariance, (6, 6), meaning)
        return said

    def change_frame(self, T_new_old: npt.ArrayLike) -> None:  # noqa: N803
        """Express everything in another target plane; see `Estimator.change_frame`."""
        with self._part.blamed("change_frame"):
            self._own.change_frame(np.array(T_new_old, dtype=float))


@cache
def tried_estimator(name: str) -> OwnPart:
    """Return an own estimator's class that has followed a needle.

    Raises
    ------
    OwnPartError
        As of `own_part`; also where it raises, says what no estimate can be, loses a needle whose
        tips are exact, does not bear a tip that was not found, or moves wrongly with the plane.
    """
    part = own_part("estimator", name)
    settings = SteeringSettings()
    rng = np.random.default_rng(0)
    estimator = OwnEstimator(part, settings, np.eye(3), np.zeros(3), rng)
    known = np.eye(3) * settings.measurement_std**2
    estimator.reset(np.zeros(3), np.zeros(2))
    tip: Array = np.zeros(3)
    for k in range(1, _TRIED_STEPS + 1):
        tip = arc(k * _STEP, 0.0, settings.curvature).shift
        estimator.advance(_STEP, 0.0)
        estimator.correct(tip, None if k % 2 else known, 0.0)
        estimator.estimate()
    off = float(np.linalg.norm(estimator.estimate().position - tip))
    if off > _NEAR:
        raise part.error(
            f"after {_TRIED_STEPS} exact tips, 1 mm apart, its position is {off:.3g} m "
            "off; it is wanted in m, in the target plane, z along the insertion"
        )
    estimator.advance(_STEP, 0.0)
    estimator.correct(np.full(3, np.nan), None, 0.0)
    before = estimator.estimate().position
    moved = np.eye(4)
    moved[0, 3] = 0.002
    estimator.change_frame(moved)
    after = estimator.estimate().position
    if not np.allclose(after, before + moved[:3, 3], rtol=0.0, atol=_FRAME_TOLERANCE):
        by = float(after[0] - before[0])
        raise part.error(f"change_frame by 0.002 m along x moves x by {by:g} m")
    return part
