"""A particle filter that knows the true model: an own estimator, and the limit of all others.

Where curvature, torsion and slip are known, a needle's way is its start moved along one path that
is the same for every start: T = T_start T_path. So a particle is a start, and a step moves none of
them, only the path; a tip weighs them by what really is the noise. Particles that the tips leave
few of are drawn anew and moved by a third of their spread, about their mean (Liu and West, 2001).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from needle_controller.bank.hypothesis_mixture import Hypotheses, MixtureEstimate
from needle_controller.model.arc_motion import arc
from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import linearized_from_reduced
from needle_controller.model.kinematics import REDUCED, angles_from_rotation, rotation_from_angles
from needle_sim.needle.tissue import Torsion
from needle_sim.studies.disturbances import Disturbances
from needle_sim.studies.start_grids import StartBounds

_SPREAD = 0.3
_EDGE = 2e-5
"""Beyond the largest error a likelihood falls off over so much [m]: no particle hits a tip."""


class ParticleFilter:
    """Estimates the tip's pose; see `estimator.Estimator`, which is all that a controller asks for.

    Parameters
    ----------
    curvature : float
        Of the needle's path, where `disturbances` do not change it [1/m].
    disturbances : Disturbances
        What is wrong, and known: the noise, outliers, curvature, torsion and slip.
    bounds : StartBounds
        Of the starts, which are uniform within.
    particles : int
        For each needle.
    seed : int
        Of all randomness.
    """

    def __init__(
        self,
        curvature: float,
        disturbances: Disturbances,
        bounds: StartBounds,
        particles: int,
        seed: int,
    ) -> None:
        self._curvature = curvature * disturbances.curvature_scale
        self._wrong = disturbances
        self._bounds = np.array([bounds.x, bounds.pitch, bounds.roll])
        self._particles = particles
        self._rng = np.random.default_rng(seed)
        self._frame: Array = np.eye(4)

    def reset(self, tip: npt.ArrayLike, joints: npt.ArrayLike) -> None:
        """Start over at a first measurement; see `Estimator.reset`."""
        tips = np.asarray(tip, dtype=float)
        self._shape = tips.shape[:-1]
        needles = int(np.prod(self._shape))
        inside = self._rng.uniform(-1.0, 1.0, (needles, self._particles, 3))
        self._starts: Array = inside * self._bounds
        self._weights: Array = np.zeros((needles, self._particles))
        self._torsion = Torsion(self._wrong.play, self._wrong.lag_length)
        turned = np.zeros((needles, 3))
        turned[:, 2] = np.broadcast_to(np.asarray(joints)[..., 1], self._shape).reshape(-1)
        self._path = [(np.zeros(needles), np.zeros((needles, 3)), rotation_from_angles(turned))]
        self._base: Array = np.zeros(needles)
        self._place_starts()
        self.correct(tips)

    def advance(self, d_insertion: npt.ArrayLike, d_rotation: npt.ArrayLike) -> None:
        """Move on by what really happened; see `Estimator.advance`."""
        inserted, shift, rotation = self._path[-1]
        length, turn = self._flat(d_insertion), self._flat(d_rotation)
        if not np.all(np.isfinite(length) & (length >= 0.0)):
            raise ValueError(f"d_insertion = {d_insertion!r} m, wants finite and >= 0")
        self._base = self._base + turn
        turned = self._torsion.advance(length, turn)
        step = arc(length / (1.0 + self._wrong.slip), turned, self._curvature)
        shift = shift + (rotation @ step.shift[..., None])[..., 0]
        self._path.append((inserted + length, shift, rotation @ step.rotation))

    def correct(
        self, tip: npt.ArrayLike, covariance: npt.ArrayLike | None = None, age: npt.ArrayLike = 0.0
    ) -> None:
        """Take a measurement; see `Estimator.correct`. What it claims of itself is not believed."""
        seen = np.asarray(tip, dtype=float).reshape(-1, 3)
        found = np.all(np.isfinite(seen), axis=1)
        inserted = np.array([row[0] for row in self._path])
        then = np.argmin(np.abs(inserted - (inserted[-1] - self._flat(age))), axis=0)
        shift = np.array([row[1] for row in self._path])[then, np.arange(len(seen))]
        off = np.where(found[:, None], seen, 0.0)[:, None] - self._places(shift)
        likelihood = self._log_likelihood(off)
        self._weights += np.where(found[:, None], likelihood, 0.0)
        self._weights -= np.max(self._weights, axis=1, keepdims=True)
        share = self._share()
        worn = 1.0 / np.sum(share**2, axis=1) < 0.5 * self._particles
        if np.any(worn):
            for n in np.flatnonzero(worn).tolist():
                self._draw_anew(n, share[n])
            self._place_starts()

    def estimate(self) -> MixtureEstimate:
        """Return what is known now; see `Estimator.estimate`."""
        _, shift, path = self._path[-1]
        share = self._share()[..., None]
        places = self._places(shift)
        headings = (self._rotation @ path[:, None, :, 2:])[..., 0]
        mean = np.sum(share[..., None] * self._rotation, axis=1) @ path
        u, _, v = np.linalg.svd(mean)
        angles = angles_from_rotation(u @ v)
        position = np.sum(share * places, axis=1)

        def covariance() -> Array:
            off = angles_from_rotation(self._rotation @ path[:, None]) - angles[:, None]
            off = (off + math.pi) % (2.0 * math.pi) - math.pi
            error = np.concatenate([places - position[:, None], off], axis=-1)
            return np.asarray(np.swapaxes(share * error, -1, -2) @ error)

        coordinates = np.concatenate([position, angles], axis=1).reshape(*self._shape, 6)
        kappa = np.full(self._shape, self._curvature)
        spread = np.stack([places[..., 0], headings[..., 0]], axis=-1)
        spread -= np.sum(share * spread, axis=1, keepdims=True)
        known = (np.swapaxes(share * spread, -1, -2) @ spread).reshape(-1, 4)[:, [0, 1, 3]]
        return MixtureEstimate(
            coordinates=coordinates,
            linearized=linearized_from_reduced(coordinates[..., REDUCED], kappa),
            curvature=kappa,
            warnings=(),
            covariance_of=lambda: covariance().reshape(*self._shape, 6, 6),
            hypotheses=self._as_hypothesis(angles, known),
        )

    def change_frame(self, T_new_old: npt.ArrayLike) -> None:  # noqa: N803
        """Express everything in another target plane; see `Estimator.change_frame`."""
        self._frame = np.asarray(T_new_old, dtype=float) @ self._frame
        self._place_starts()

    def _place_starts(self) -> None:
        angles = np.zeros((*self._starts.shape[:2], 3))
        angles[..., 1:] = self._starts[..., 1:]
        turn = self._frame[:3, :3]
        self._rotation = turn @ rotation_from_angles(angles)
        self._position = self._starts[..., :1] * turn[:, 0] + self._frame[:3, 3]

    def _places(self, shift: Array) -> Array:
        return np.asarray(self._position + np.einsum("npij,nj->npi", self._rotation, shift))

    def _share(self) -> Array:
        weights = np.exp(self._weights)
        return np.asarray(weights / np.sum(weights, axis=1, keepdims=True))

    def _draw_anew(self, n: int, share: Array) -> None:
        starts, count = self._starts[n], self._particles
        mean = share @ starts
        spread = np.cov(starts.T, aweights=share)
        places = (np.arange(count) + self._rng.random()) / count
        drawn = starts[np.minimum(np.searchsorted(np.cumsum(share), places), count - 1)]
        moved = self._rng.multivariate_normal(np.zeros(3), spread, count, method="eigh")
        self._starts[n] = mean + math.sqrt(1.0 - _SPREAD**2) * (drawn - mean) + _SPREAD * moved
        self._weights[n] = 0.0

    def _log_likelihood(self, off: Array) -> Array:
        wrong = self._wrong
        if wrong.noise_shape == "normal":
            density = -0.5 * np.sum((off / wrong.noise) ** 2, axis=-1)
            density -= 3.0 * math.log(wrong.noise * math.sqrt(2.0 * math.pi))
        else:
            beyond = np.maximum(np.abs(off) - wrong.noise, 0.0) / _EDGE
            density = -0.5 * np.sum(beyond**2, axis=-1) - 3.0 * math.log(2.0 * wrong.noise)
        if wrong.outliers == 0.0:
            return np.asarray(density)
        distance = np.linalg.norm(off, axis=-1)
        low, high = wrong.outlier_size
        far = (low <= distance) & (distance <= high)
        there = np.where(
            far, 1.0 / (4.0 * math.pi * (high - low) * np.maximum(distance, low) ** 2), 0.0
        )
        both = (1.0 - wrong.outliers) * np.exp(density) + wrong.outliers * there
        return np.asarray(np.log(both + 1e-6))

    def _as_hypothesis(self, angles: Array, known: Array) -> Hypotheses:
        torsion, wrong, shape = self._torsion, self._wrong, self._shape
        roll, sure = angles[:, 2], 1.0
        turned = torsion.tip_angle, torsion.behind_play, wrong.play, wrong.lag_length
        # In the order of `Hypotheses.table`.
        columns = np.broadcast_arrays(roll, sure, self._curvature, *turned, sure)
        table, base = np.stack(columns, axis=-1), self._base.reshape(shape)
        return Hypotheses(table.reshape(*shape, 1, -1), base, base, known.reshape(*shape, 3))

    def _flat(self, values: npt.ArrayLike) -> Array:
        shaped = np.broadcast_to(np.asarray(values, dtype=float), self._shape)
        return np.asarray(shaped.reshape(-1))
