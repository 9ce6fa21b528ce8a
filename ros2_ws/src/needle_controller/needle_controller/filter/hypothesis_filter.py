"""A bank of extended Kalman filters on SE(3), one for each hypothesis of torsion, roll and noise.

Each estimates the tip's full pose, the curvature and one torsion parameter from all three
coordinates of the measured tips. Hypotheses that explain the tips badly lose weight and are
removed.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from needle_controller.filter.bank import advance_needle, correct_needle, start_needle
from needle_controller.filter.filter_settings import FilterSettings
from needle_controller.filter.mixture import estimate_from_record, estimate_needle
from needle_controller.filter.records import ERROR
from needle_controller.observers.estimator import Estimate

AMBIGUOUS_WEIGHT = 0.1
MAX_OUTLIERS = 0.35
"""Largest acceptable share of outliers among about the last ten tips."""
LARGEST_NOISE = 3.0
"""Largest acceptable noise, relative to the claimed one."""
LARGEST_SLIP = 0.15
"""Largest acceptable distance of the insertion scale from 1."""
_AT_LIMIT = 0.03
LATE = "tips lag the insertion from the start: late tips or a stuck needle; assumed late"
_EVENTS = 4096
"""Largest number of recorded events of the first 2 cm, for the detection of late tips."""


class HypothesisFilter:
    """Estimates the tip's pose, curvature and torsion; see `estimator.Estimator`.

    Tips may be older than their stamps; this is detected over the first 2 cm (`late_tips`).

    Parameters
    ----------
    settings : FilterSettings
        Assumptions.
    initial_rotation : array_like, shape (3, 3), optional
        Orientation of a needle at its entry with the base's rotation at 0, in `target_plane`;
        identity by default.
    entry : array_like, shape (3,), optional
        Entry point in `target_plane` [m]: position of the tip with the stage at 0, along the needle
        to within 0.5 mm; unknown by default.
    """

    def __init__(
        self,
        settings: FilterSettings,
        initial_rotation: npt.ArrayLike | None = None,
        entry: npt.ArrayLike | None = None,
    ) -> None:
        self.settings, self._bank = settings, settings.bank(1, _EVENTS)
        self.needle = self._bank.needles[0]
        self.needle["initial_rotation"] = (
            np.eye(3) if initial_rotation is None else initial_rotation
        )
        if entry is not None:
            self.needle["has_entry"], self.needle["entry"] = True, entry
        self.reset(np.zeros(3), np.zeros(2))

    @property
    def hypotheses(self) -> npt.NDArray[np.void]:
        """View of the present hypotheses, shape (H,), `records.HYPOTHESIS`."""
        return self._bank.hypotheses[0, : self.needle["count"]]

    def reset(self, tip: npt.ArrayLike, joints: npt.ArrayLike) -> None:
        """Start at a first measurement (NaN: position unknown); see `Estimator.reset`."""
        insertion, turn = np.asarray(joints, dtype=float).tolist()
        start_needle(self._bank, 0, np.array(tip, dtype=float), insertion, turn)

    def advance(self, d_insertion: float, d_rotation: float) -> None:
        """Advance by the actual motion; see `Estimator.advance`."""
        length, turn = float(d_insertion), float(d_rotation)
        if not (np.isfinite(length) and length >= 0.0):
            raise ValueError(f"d_insertion = {length!r} m, expected finite and >= 0")
        if not np.isfinite(turn):
            raise ValueError(f"d_rotation = {turn!r} rad, expected finite")
        advance_needle(self._bank, 0, length, turn)

    def correct(
        self, tip: npt.ArrayLike, covariance: npt.ArrayLike | None = None, age: float = 0.0
    ) -> None:
        """Correct by a measured tip; see `Estimator.correct`.

        Without a covariance the noise is assumed to be bounded (`tip_noise_bound`), otherwise
        Gaussian; in both cases it includes `model_error`. A tip older than the last one is dropped
        with a warning.
        """
        noise = self.settings.tip_covariance(covariance)
        correct_needle(self._bank, 0, np.array(tip, dtype=float), noise, float(age))

    def correct_heading(self, direction: npt.ArrayLike, variance: float) -> None:
        """Use a measured heading in the next `correct`.

        Parameters
        ----------
        direction : array_like, shape (3,)
            Unit vector in `target_plane`, measured at the exposure of that tip.
        variance : float
            Variance of its angle in each direction [rad^2].
        """
        self.needle["heading"] = [*np.asarray(direction, dtype=float), variance]

    def estimate(self) -> Estimate:
        """Return the present estimate; see `Estimator.estimate`."""
        estimate_needle(self._bank, 0)
        mean, torsions = self._bank.estimates[0].copy(), self._bank.torsions[0].copy()
        return estimate_from_record(mean, torsions, self._warnings(mean))

    def change_frame(self, T_new_old: npt.ArrayLike) -> None:  # noqa: N803
        """Transform everything into another target plane; see `Estimator.change_frame`."""
        transform = np.asarray(T_new_old, dtype=float)
        turn, shift = transform[:3, :3], transform[:3, 3]
        needle, h = self.needle, self.hypotheses
        needle["initial_rotation"] = turn @ needle["initial_rotation"]
        for name in ("entry", "start"):
            needle[name] = turn @ needle[name] + shift
        h["position"] = h["position"] @ turn.T + shift
        h["rotation"] = turn @ h["rotation"]
        h["residual"] = h["residual"] @ turn.T
        turns = np.eye(ERROR)
        turns[:3, :3] = turns[3:6, 3:6] = turn
        h["covariance"] = turns @ h["covariance"] @ turns.T
        events = self._bank.events[0, : max(needle["events"], 0)]
        events["tip"] = events["tip"] @ turn.T + shift
        events["covariance"] = turn @ events["covariance"] @ turn.T
        events["heading"][:, :3] = events["heading"][:, :3] @ turn.T

    def _warnings(self, mean: np.void) -> tuple[str, ...]:
        needle, assumed, ambiguous = self.needle, self._bank.assumed[0], mean["ambiguous"]
        margin = _AT_LIMIT * assumed["curvature"]
        low, high = assumed["smallest_curvature"] + margin, assumed["largest_curvature"] - margin
        warnings = {
            f"the roll is ambiguous: {100.0 * ambiguous:.0f} % for another value": (
                ambiguous > AMBIGUOUS_WEIGHT
            ),
            "tip refused as an outlier": needle["outlier_probability"] > 0.5,
            "tip dropped: it is older than the last one used": needle["tip_too_late"],
            "too many tips are outliers": needle["mean_outlier_probability"] > MAX_OUTLIERS,
            "tips are far noisier than claimed": mean["noise"] > LARGEST_NOISE,
            "the needle does not advance with the stage": abs(mean["scale"] - 1.0) > LARGEST_SLIP,
            "the curvature is at its limit": not low <= mean["curvature"] <= high,
            LATE: needle["late"] > 0.0,
        }
        return tuple(text for text, applies in warnings.items() if applies)
