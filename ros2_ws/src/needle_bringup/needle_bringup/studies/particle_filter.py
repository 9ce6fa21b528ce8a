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

from needle_controller.filter.records import TORSION
from needle_controller.model.arc_motion import arc
from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import linearized_from_reduced
from needle_controller.model.kinematics import REDUCED, angles_from_rotation, rotation_from_angles
from needle_controller.observers.estimator import Estimate, Hypotheses
from needle_sim.needle.tissue import Torsion
from needle_sim.studies.disturbances import Disturbances
from needle_sim.studies.study import StartBounds

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
        How many.
    rng : numpy.random.Generator
        All randomness.
    """

    def __init__(
        self,
        curvature: float,
        disturbances: Disturbances,
        bounds: StartBounds,
        particles: int,
        rng: np.random.Generator,
    ) -> None:
        self._curvature = curvature * disturbances.curvature_scale
        self._wrong = disturbances
        self._bounds = np.array([bounds.x, bounds.pitch, bounds.roll])
        self._particles = particles
        self._rng = rng
        self._frame: Array = np.eye(4)

    def reset(self, tip: npt.ArrayLike, joints: npt.ArrayLike) -> None:
        """Start over at a first measurement; see `Estimator.reset`."""
        inside = self._rng.uniform(-1.0, 1.0, (self._particles, 3))
        self._starts: Array = inside * self._bounds
        self._weights: Array = np.zeros(self._particles)
        self._torsion = Torsion(self._wrong.play, self._wrong.lag_length)
        turned = float(np.asarray(joints, dtype=float)[1])
        self._path = [(0.0, np.zeros(3), rotation_from_angles([0.0, 0.0, turned]))]
        self._base = 0.0
        self._place_starts()
        self.correct(tip)

    def advance(self, d_insertion: float, d_rotation: float) -> None:
        """Move on by what really happened; see `Estimator.advance`."""
        inserted, shift, rotation = self._path[-1]
        length, turn = float(d_insertion), float(d_rotation)
        if not (math.isfinite(length) and length >= 0.0):
            raise ValueError(f"d_insertion = {length!r} m, wants finite and >= 0")
        self._base += turn
        turned = self._torsion.advance(length, turn)
        step = arc(length / (1.0 + self._wrong.slip), turned, self._curvature)
        self._path.append(
            (inserted + length, shift + rotation @ step.shift, rotation @ step.rotation)
        )

    def correct(
        self, tip: npt.ArrayLike, covariance: npt.ArrayLike | None = None, age: float = 0.0
    ) -> None:
        """Take a measurement; see `Estimator.correct`. What it claims of itself is not believed."""
        seen = np.asarray(tip, dtype=float)
        if not np.all(np.isfinite(seen)):
            return
        inserted = np.array([row[0] for row in self._path])
        then = int(np.argmin(np.abs(inserted - (inserted[-1] - age))))
        self._weights += self._log_likelihood(seen - self._places(self._path[then][1]))
        self._weights -= np.max(self._weights)
        share = self._share()
        if 1.0 / np.sum(share**2) < 0.5 * self._particles:
            self._draw_anew(share)
            self._place_starts()

    def estimate(self) -> Estimate:
        """Return what is known now; see `Estimator.estimate`."""
        _, shift, path = self._path[-1]
        share, places, turns = self._share(), self._places(shift), self._rotation @ path
        u, _, v = np.linalg.svd(np.tensordot(share, turns, 1))
        position, angles = share @ places, angles_from_rotation(u @ v)
        off = (angles_from_rotation(turns) - angles + math.pi) % (2.0 * math.pi) - math.pi
        error = np.concatenate([places - position, off], axis=1)
        spread = np.stack([places[:, 0], turns[:, 0, 2]], axis=1)
        spread -= share @ spread
        known = ((share[:, None] * spread).T @ spread).ravel()[[0, 1, 3]]
        coordinates = np.concatenate([position, angles])
        return Estimate(
            coordinates=coordinates,
            linearized=linearized_from_reduced(coordinates[list(REDUCED)], self._curvature),
            curvature=self._curvature,
            covariance=(share[:, None] * error).T @ error,
            hypotheses=self._as_hypothesis(float(angles[2]), known),
        )

    def change_frame(self, T_new_old: npt.ArrayLike) -> None:  # noqa: N803
        """Express everything in another target plane; see `Estimator.change_frame`."""
        self._frame = np.asarray(T_new_old, dtype=float) @ self._frame
        self._place_starts()

    def _place_starts(self) -> None:
        angles = self._starts * [0.0, 1.0, 1.0]
        turn = self._frame[:3, :3]
        self._rotation = turn @ rotation_from_angles(angles)
        self._position = self._starts[:, :1] * turn[:, 0] + self._frame[:3, 3]

    def _places(self, shift: Array) -> Array:
        return np.asarray(self._position + self._rotation @ shift)

    def _share(self) -> Array:
        weights = np.exp(self._weights)
        return np.asarray(weights / np.sum(weights))

    def _draw_anew(self, share: Array) -> None:
        starts, count = self._starts, self._particles
        mean, spread = share @ starts, np.cov(starts.T, aweights=share)
        places = (np.arange(count) + self._rng.random()) / count
        drawn = starts[np.minimum(np.searchsorted(np.cumsum(share), places), count - 1)]
        moved = self._rng.multivariate_normal(np.zeros(3), spread, count, method="eigh")
        self._starts = mean + math.sqrt(1.0 - _SPREAD**2) * (drawn - mean) + _SPREAD * moved
        self._weights = np.zeros(count)

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

    def _as_hypothesis(self, roll: float, known: Array) -> Hypotheses:
        only, torsion, wrong = np.zeros(1, TORSION), self._torsion, self._wrong
        only["roll"], only["curvature"] = roll, self._curvature
        only["agreement"] = only["weight"] = only["gain"] = 1.0
        only["tip_angle"], only["behind_play"] = torsion.tip_angle, torsion.behind_play
        only["play"], only["lag"] = wrong.play, wrong.lag_length
        return Hypotheses(only, self._base, self._base, known)
