"""A bank of extended Kalman filters on SE(3), one for each hypothesis of torsion and start roll.

Each estimates the tip's full pose, the curvature and the size of its torsion from all three
coordinates of the measured tips. Hypotheses that explain the tips badly lose weight and end.
"""

from __future__ import annotations

from typing import cast

import numpy as np
import numpy.typing as npt

from needle_controller.bank.doubts import doubts_of
from needle_controller.bank.estimate_tiles import (
    ERROR,
    REMAINDER,
    P,
    R,
    X,
    covariances,
    lower_half,
    rows,
    set_rows,
    tidied,
)
from needle_controller.bank.filter_settings import FilterSettings
from needle_controller.bank.hypothesis_bank import Bank, advance_bank, correct_bank
from needle_controller.bank.hypothesis_mixture import (
    COLUMNS,
    L_CURVATURE,
    LEARNED,
    Hypotheses,
    MixtureEstimate,
    mixture,
    mixture_covariance,
)
from needle_controller.bank.hypothesis_pruning import merge
from needle_controller.bank.hypothesis_start import start_bank
from needle_controller.bank.tip_update import ALONG, BOUND, FOUND, READ, READING_ROWS
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles

AMBIGUOUS_WEIGHT = 0.1
AGE_TOLERANCE = 1e-9
_LONGEST_QUEUE = 64
SMALLEST_VARIANCE = 1e-18
"""Of a measured coordinate [m^2]: an exact one would leave nothing to divide by."""
TIDY_EVERY = 8
"""Tips from one look for hypotheses that have ended or become the same to the next."""


class HypothesisFilter:
    """Estimates the tip's pose, curvature and torsion; see `estimator.Estimator`.

    What was inserted since the last tip waits in a queue, so that a late tip is taken at the place
    of its exposure; `estimate` looks ahead through the queue.

    Parameters
    ----------
    settings : FilterSettings
        What is assumed.
    initial_rotation : array_like, shape (3, 3), optional
        Orientation of a needle at its entry with the base's rotation at 0, in `target_plane`;
        identity by default.
    """

    def __init__(
        self, settings: FilterSettings, initial_rotation: npt.ArrayLike | None = None
    ) -> None:
        self.settings = settings
        self.initial_rotation: Array = (
            np.eye(3) if initial_rotation is None else np.asarray(initial_rotation, dtype=float)
        )
        self.reset(np.zeros(3), np.zeros(2))

    def reset(self, tip: npt.ArrayLike, joints: npt.ArrayLike) -> None:
        """Start at a first measurement (NaN: position unknown); see `Estimator.reset`."""
        tip, joints = np.asarray(tip, dtype=float), np.asarray(joints, dtype=float)
        self._shape = np.broadcast_shapes(tip.shape[:-1], joints.shape[:-1])
        needles = int(np.prod(self._shape))
        start = np.broadcast_to(tip, (*self._shape, 3)).reshape(needles, 3)
        turned = np.zeros((needles, 3))
        turned[:, 2] = np.broadcast_to(joints[..., 1], self._shape).reshape(needles)
        rotation = self.initial_rotation @ rotation_from_angles(turned)
        self._bank = start_bank(self.settings, start, rotation)
        self._start_turn = turned[:, 2].copy()
        self._queue: list[tuple[Array, Array]] = []
        self._too_late = np.zeros(needles, dtype=bool)
        self._version = self._corrections = 0

    def advance(self, d_insertion: npt.ArrayLike, d_rotation: npt.ArrayLike) -> None:
        """Move on by what really happened; see `Estimator.advance`."""
        length = self._flat(d_insertion)
        turn = self._flat(d_rotation)
        if not (np.all(np.isfinite(length)) and np.all(length >= 0.0)):
            raise ValueError(f"d_insertion = {d_insertion!r} m, wants finite and >= 0")
        if not np.all(np.isfinite(turn)):
            raise ValueError(f"d_rotation = {d_rotation!r} rad, wants finite")
        self._version += 1
        self._queue.append((length, turn))
        if len(self._queue) > _LONGEST_QUEUE:
            self._move(self._bank, *self._queue.pop(0))

    def correct(
        self, tip: npt.ArrayLike, covariance: npt.ArrayLike | None = None, age: npt.ArrayLike = 0.0
    ) -> None:
        """Take a measurement; see `Estimator.correct`.

        Without a covariance the noise is taken as bounded (`tip_noise_bound`), with one as
        Gaussian; neither as less than `model_error` allows. A tip older than the last one is
        dropped, and `estimate` says so.
        """
        position = np.broadcast_to(np.asarray(tip, dtype=float), (*self._shape, 3))
        position = np.array(position.reshape(-1, 3))
        self._version += 1
        self._corrections += 1
        self._too_late = self._catch_up(self._flat(age))
        if np.any(self._too_late):
            position = np.where(self._too_late[:, None], np.nan, position)
        settings = self.settings
        if covariance is None:
            noise = np.eye(3)[None] * (settings.believed_bound**2 / 3.0)
        else:
            noise = self._covariances(covariance) + np.eye(3) * settings.model_error**2
        correct_bank(
            self._bank,
            readings(position, noise),
            settings.noises(),
            settings.limits(),
        )
        if self._corrections % TIDY_EVERY == 0:
            merge(self._bank.tiles, settings.merge_angle)
            self._bank = self._bank._replace(tiles=tidied(self._bank.tiles))

    def estimate(self) -> MixtureEstimate:
        """Return what is known now; see `Estimator.estimate`.

        Its covariance is to be read before the next `advance`, `correct` or `reset`.
        """
        bank = self._looked_ahead()
        needles, kinds = bank.base.size, len(self.settings.torsion_hypotheses)
        coordinates, linearized = np.empty((needles, 6)), np.empty((needles, 3))
        learned, ambiguous = np.empty((needles, LEARNED)), np.empty(needles)
        table = np.empty((needles, kinds, COLUMNS))
        uncertainty = np.empty((needles, 3))
        noises = self.settings.noises()
        mixture(bank.tiles, noises, coordinates, linearized, learned, ambiguous, table, uncertainty)
        doubts = doubts_of(learned, uncertainty[:, 0], bank.unexplained, self.settings)
        version = self._version

        def covariance() -> Array:
            if self._version != version:
                raise RuntimeError("the estimator has moved on since this estimate")
            of_all = mixture_covariance(self._looked_ahead().tiles, coordinates)
            return of_all.reshape(*self._shape, 6, 6)

        shape = self._shape
        return MixtureEstimate(
            coordinates=coordinates.reshape(*shape, 6),
            linearized=linearized.reshape(*shape, 3),
            curvature=learned[:, L_CURVATURE].reshape(shape),
            warnings=self._warnings(ambiguous),
            covariance_of=covariance,
            doubtful=np.any(list(doubts.values()), axis=0).reshape(shape),
            doubts=tuple(why for why, there in doubts.items() if np.any(there)),
            hypotheses=Hypotheses(
                table=table.reshape(*shape, kinds, COLUMNS),
                base=bank.base.reshape(shape).copy(),
                wound=(bank.base + self._start_turn).reshape(shape),
                uncertainty=uncertainty.reshape(*shape, 3),
            ),
        )

    def change_frame(self, T_new_old: npt.ArrayLike) -> None:  # noqa: N803
        """Express everything in another target plane; see `Estimator.change_frame`."""
        transform = np.asarray(T_new_old, dtype=float)
        turn = transform[:3, :3]
        tiles = self._bank.tiles
        self._version += 1
        self.initial_rotation = turn @ self.initial_rotation
        set_rows(tiles, X, rows(tiles, X, 3) @ turn.T + transform[:3, 3])
        rotation = turn @ rows(tiles, R, 9).reshape(-1, 3, 3)
        set_rows(tiles, R, rotation.reshape(-1, 9))
        set_rows(tiles, REMAINDER, rows(tiles, REMAINDER, 3) @ turn.T)
        turns = np.eye(ERROR)
        turns[:3, :3] = turns[3:6, 3:6] = turn
        set_rows(tiles, P, lower_half(turns @ covariances(tiles) @ turns.T))

    def _move(self, bank: Bank, length: Array, turn: Array) -> None:
        """Carry a bank over an advance."""
        advance_bank(bank, length, turn, self.settings.longest_step, self.settings.drift())

    def _catch_up(self, age: Array) -> npt.NDArray[np.bool_]:
        """Carry the bank to where the tip was exposed; return where it was past that already."""
        pending = np.sum([length for length, _ in self._queue], axis=0) + np.zeros(len(age))
        ahead = pending - age
        too_late = ahead < -AGE_TOLERANCE
        queue, self._queue = self._queue, []
        for length, turn in queue:
            take = np.clip(ahead, 0.0, length)
            # What only turned belongs to the place it turned at.
            turned = (ahead > 0.0) | (age <= AGE_TOLERANCE)
            share = np.where(length > 0.0, take / np.where(length > 0.0, length, 1.0), turned)
            share = np.where(share > 1.0 - 1e-9, 1.0, share)
            if np.any(share > 0.0):
                self._move(self._bank, share * length, share * turn)
            ahead = ahead - take
            if np.any(share < 1.0):
                self._queue.append(((1.0 - share) * length, (1.0 - share) * turn))
        return cast(npt.NDArray[np.bool_], too_late)

    def _looked_ahead(self) -> Bank:
        """Return the bank as it will be at the end of the queue; itself where that is empty."""
        if not self._queue:
            return self._bank
        bank = self._bank._replace(
            tiles=self._bank.tiles._replace(state=self._bank.tiles.state.copy()),
            base=self._bank.base.copy(),
        )
        for length, turn in self._queue:
            self._move(bank, length, turn)
        return bank

    def _warnings(self, ambiguous: Array) -> tuple[str, ...]:
        warnings = []
        if np.any(ambiguous > AMBIGUOUS_WEIGHT):
            worst = float(np.max(ambiguous))
            warnings.append(f"the roll is not known yet: {100.0 * worst:.0f} % says otherwise")
        if np.any(self._bank.refused > 0.5):
            warnings.append("tip refused as an outlier")
        if np.any(self._too_late):
            warnings.append("tip dropped: it is older than the last one used")
        return tuple(warnings)

    def _covariances(self, covariance: npt.ArrayLike) -> Array:
        matrix = np.asarray(covariance, dtype=float)
        if matrix.ndim == 2:
            return matrix[None]
        return np.broadcast_to(matrix, (*self._shape, 3, 3)).reshape(-1, 3, 3)

    def _flat(self, values: npt.ArrayLike) -> Array:
        shaped = np.broadcast_to(np.asarray(values, dtype=float), self._shape)
        # A copy: what cannot be written to is another type to compiled code, compiled once more.
        return np.array(shaped.reshape(-1))


def readings(position: Array, noise: Array) -> Array:
    """Return tips as `take_tip` wants them.

    Parameters
    ----------
    position : ndarray, shape (N, 3)
        The tips [m]; not finite where there is none.
    noise : ndarray, shape (N or 1, 3, 3)
        Their covariance [m^2]; not finite where there is no tip.

    Returns
    -------
    ndarray, shape (N, READING_ROWS)
        Read along the rows of L^-1, noise = L D L^T, where the errors are independent.
    """
    found = np.all(np.isfinite(position), axis=1) & np.all(np.isfinite(noise), axis=(1, 2))
    tip = np.where(found[:, None], position, 0.0)
    n = np.where(found[:, None, None], noise, np.eye(3))
    # numpy's own elementary operations, whose bits do not depend on how many needles there are.
    d0 = np.maximum(n[:, 0, 0], SMALLEST_VARIANCE)
    l10, l20 = n[:, 1, 0] / d0, n[:, 2, 0] / d0
    d1 = np.maximum(n[:, 1, 1] - l10 * l10 * d0, SMALLEST_VARIANCE)
    l21 = (n[:, 2, 1] - l20 * l10 * d0) / d1
    d2 = np.maximum(n[:, 2, 2] - l20 * l20 * d0 - l21 * l21 * d1, SMALLEST_VARIANCE)
    rows_of = np.zeros((len(tip), READING_ROWS))
    rows_of[:, FOUND] = found
    along = rows_of[:, ALONG:BOUND].reshape(-1, 3, 3)
    along[:, [0, 1, 2], [0, 1, 2]] = 1.0
    along[:, 1, 0], along[:, 2, 0], along[:, 2, 1] = -l10, l21 * l10 - l20, -l21
    y = tip[:, 1] - l10 * tip[:, 0]
    rows_of[:, READ], rows_of[:, READ + 1] = tip[:, 0], y
    rows_of[:, READ + 2] = tip[:, 2] - l21 * y - l20 * tip[:, 0]
    rows_of[:, BOUND:] = np.sqrt(3.0 * np.stack([d0, d1, d2], axis=1))
    return rows_of
