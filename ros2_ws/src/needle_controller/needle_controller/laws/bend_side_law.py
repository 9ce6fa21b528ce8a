"""The paper's law on both sides of roll +-90 deg: (7) and (10) with the sign of cos(roll)."""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from needle_controller.laws.law import Command, LinearizingLaw
from needle_controller.observers.bend_side import bend_sign_of, reduced_on_side, wrapped
from needle_controller.observers.estimator import Estimate
from needle_controller.observers.saturation import saturate


@dataclasses.dataclass(frozen=True)
class TwoSidedLinearizingLaw:
    """`LinearizingLaw` for a bevel that is flipped; without flips the same as that.

    s does not know the sides, and u changes its effect on s3 with the sign of cos(roll): what is
    looked up on the wanted side is the roll that has the demanded s3. While the roll is on the
    other side it is turned mirrored, to the roll whose s3 the law wants at rest, s3 = -(K1 s1 + K2
    s2) / K3: what s3 is halfway through a flip is not what the law should start from.

    Attributes
    ----------
    law : LinearizingLaw
        Gains and limits.
    """

    law: LinearizingLaw

    def __call__(self, estimate: Estimate, bend_sign: npt.ArrayLike = 0.0) -> Command:
        """Return the rotation rate to hold over the next step.

        Parameters
        ----------
        estimate : Estimate
            With a roll in (-pi, pi].
        bend_sign : array_like, shape (...)
            Wanted sign of cos(roll), +1 or -1; 0 stays on the present side.
        """
        law = self.law
        s, length, curvature = estimate.linearized, law.step_length, estimate.curvature
        v = -(s @ law.feedback)
        s2 = s[..., 1] + length * s[..., 2] + 0.5 * length**2 * v
        s3 = s[..., 2] + length * v
        pitch, roll = estimate.reduced[..., 1], estimate.reduced[..., 2]
        present = bend_sign_of(roll)
        given = np.asarray(bend_sign, dtype=float)
        sign = np.where(given == 0.0, present, np.copysign(1.0, given))
        flipping = sign != present
        gains = law.feedback
        at_rest = -(gains[0] * s[..., 0] + gains[1] * s[..., 1]) / gains[2]
        s2 = np.where(flipping, s[..., 1], s2)
        s3 = np.where(flipping, at_rest, s3)
        parts = np.broadcast_arrays(s[..., 0], s2, s3)
        demanded, _ = saturate(np.stack(parts, axis=-1), curvature, law.demand_margin)
        wanted_roll = reduced_on_side(demanded, curvature, sign)[..., 2]
        # The roll's own drift, (5).
        drift = -curvature * np.cos(roll) * np.tan(pitch)
        limit = law.max_rotation_per_length
        rate = np.clip(wrapped(wanted_roll - roll) / length - drift, -limit, limit)
        return Command(np.asarray(v), np.asarray(rate))
