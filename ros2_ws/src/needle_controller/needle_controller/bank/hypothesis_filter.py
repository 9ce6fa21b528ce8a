"""A bank of extended Kalman filters on SE(3), one for each hypothesis of torsion and start roll.

Each estimates the tip's full pose, the curvature and the size of its torsion from all three
coordinates of the measured tips. Hypotheses that explain the tips badly lose weight and end.
"""

from __future__ import annotations

from typing import cast

import numpy as np
import numpy.typing as npt

from needle_controller.bank.filter_settings import FilterSettings
from needle_controller.bank.hypothesis_bank import Bank, advance_bank, correct_bank
from needle_controller.bank.hypothesis_lanes import (
    ERROR,
    R00,
    X,
    covariances,
    rows,
    set_covariances,
    set_rows,
)
from needle_controller.bank.hypothesis_mixture import (
    COLUMNS,
    Hypotheses,
    MixtureEstimate,
    mixture,
    mixture_covariance,
)
from needle_controller.bank.hypothesis_start import start_bank, start_over
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles

AMBIGUOUS_WEIGHT = 0.1
AGE_TOLERANCE = 1e-9
_LONGEST_QUEUE = 64
MERGE_EVERY = 5
"""Tips from one look for hypotheses that have become the same to the next."""


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
        self._refused_in_row = np.zeros(needles, dtype=np.int64)
        self._too_late = np.zeros(needles, dtype=bool)
        self._evidence = np.zeros(needles)
        self._started_over = np.zeros(needles, dtype=bool)
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
            self._move(*self._queue.pop(0))

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
            bound = settings.believed_bound
            noise = np.eye(3)[None] * (bound**2 / 3.0)
        else:
            noise, bound = self._covariances(covariance), 0.0
            finite = np.all(np.isfinite(noise), axis=(1, 2))
            if not np.all(finite):
                position = np.where(finite[:, None], position, np.nan)
            noise = noise + np.eye(3) * settings.model_error**2
        correct_bank(
            self._bank,
            position,
            noise,
            bound,
            settings.tip_noise_softness**2,
            settings.limits(),
            self._corrections % MERGE_EVERY == 0,
            self._refused_in_row,
            self._evidence,
        )
        lost = np.nonzero(self._evidence < settings.lost_below)[0]
        if lost.size:
            self._bank = start_over(self._bank, lost, settings)
            self._evidence[lost] = 0.0
            self._started_over[lost] = True

    def estimate(self) -> MixtureEstimate:
        """Return what is known now; see `Estimator.estimate`.

        Its covariance is to be read before the next `advance`, `correct` or `reset`.
        """
        bank = self._looked_ahead()
        needles, kinds = bank.alive.size, len(self.settings.torsion_hypotheses)
        coordinates, linearized = np.empty((needles, 6)), np.empty((needles, 3))
        curvature, ambiguous = np.empty(needles), np.empty(needles)
        table = np.empty((needles, kinds, COLUMNS))
        uncertainty = np.empty((needles, 3))
        mixture(bank, coordinates, linearized, curvature, ambiguous, table, uncertainty)
        version = self._version

        def covariance() -> Array:
            if self._version != version:
                raise RuntimeError("the estimator has moved on since this estimate")
            of_all = mixture_covariance(self._looked_ahead(), coordinates)
            return of_all.reshape(*self._shape, 6, 6)

        shape = self._shape
        return MixtureEstimate(
            coordinates=coordinates.reshape(*shape, 6),
            linearized=linearized.reshape(*shape, 3),
            curvature=curvature.reshape(shape),
            warnings=self._warnings(ambiguous, curvature),
            covariance_of=covariance,
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
        bank = self._bank
        self._version += 1
        self.initial_rotation = turn @ self.initial_rotation
        state = bank.state.copy()
        set_rows(state, X, rows(state, X, 3) @ turn.T + transform[:3, 3])
        rotation = rows(state, R00, 9)
        turned = turn @ rotation.reshape(*rotation.shape[:2], 3, 3)
        set_rows(state, R00, turned.reshape(rotation.shape))
        turns = np.eye(ERROR)
        turns[:3, :3] = turns[3:6, 3:6] = turn
        set_covariances(state, turns @ covariances(state) @ turns.T)
        self._bank = bank._replace(state=state)

    def _move(self, length: Array, turn: Array) -> None:
        """Carry the bank over an advance."""
        advance_bank(self._bank, length, turn, self.settings.limits())

    def _catch_up(self, age: Array) -> npt.NDArray[np.bool_]:
        """Carry the bank to where the tip was exposed; return where it was past that already."""
        pending = np.sum([length for length, _ in self._queue], axis=0) + np.zeros(len(age))
        ahead = pending - age
        too_late = ahead < -AGE_TOLERANCE
        if np.all(np.abs(age) <= AGE_TOLERANCE):
            for length, turn in self._queue:
                self._move(length, turn)
            self._queue = []
            return cast(npt.NDArray[np.bool_], too_late)
        while self._queue and np.any(ahead > AGE_TOLERANCE):
            length, turn = self._queue.pop(0)
            take = np.clip(ahead, 0.0, length)
            # What only turned belongs to the place it turned at.
            share = np.where(length > 0.0, take / np.where(length > 0.0, length, 1.0), ahead > 0.0)
            share = np.where(share > 1.0 - 1e-9, 1.0, share)
            self._move(share * length, share * turn)
            ahead = ahead - take
            if np.any(share < 1.0):
                rest = 1.0 - share
                self._queue.insert(0, (rest * length, rest * turn))
                if not np.any(take > 0.0):
                    break
        return cast(npt.NDArray[np.bool_], too_late)

    def _looked_ahead(self) -> Bank:
        """Return the bank as it will be at the end of the queue; itself where that is empty."""
        if not self._queue:
            return self._bank
        bank = Bank(self._bank.alive, self._bank.state.copy(), self._bank.base.copy())
        for length, turn in self._queue:
            advance_bank(bank, length, turn, self.settings.limits())
        return bank

    def _warnings(self, ambiguous: Array, curvature: Array) -> tuple[str, ...]:
        settings = self.settings
        least, most = (share * settings.curvature for share in settings.curvature_range)
        warnings = []
        if np.any(ambiguous > AMBIGUOUS_WEIGHT):
            worst = float(np.max(ambiguous))
            warnings.append(f"the roll is not known yet: {100.0 * worst:.0f} % says otherwise")
        if np.any(self._refused_in_row > 0):
            warnings.append(
                f"tip refused as an outlier, {int(np.max(self._refused_in_row))} in a row"
            )
        if np.any(self._started_over):
            warnings.append("nothing explained the tips any more: the roll was looked for anew")
        if np.any(self._too_late):
            warnings.append("tip dropped: it is older than the last one used")
        if np.any((curvature <= least) | (curvature >= most)):
            warnings.append(f"the curvature is at its limit, [{least:.3g}, {most:.3g}] 1/m")
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
