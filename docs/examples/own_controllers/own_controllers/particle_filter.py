"""An estimator: a particle filter with the needle's own model.

All particles make the same way, T = T_start T_way, so a particle is a start: a step moves the way
alone. Where tips leave few of them likely they are drawn anew, moved by some of their spread.
"""

import numpy as np

from needle_controller.model.arc_motion import arc, rotation_exp
from needle_controller.model.kinematics import angles_from_rotation
from needle_controller.observers.estimator import pose_estimate

PARTICLES, MOVED = 500, 0.6
TURN_STD = np.radians([6.0, 6.0, 18.0])  # of a start, about x, y and z of the tip


class ParticleFilter:
    """Knows the curvature, and no torsion, slip or outliers."""

    def __init__(self, settings, initial_rotation, entry, rng):
        self.settings, self.rng, self.frame = settings, rng, np.eye(4)
        self.initial_rotation = initial_rotation

    def reset(self, tip, joints):
        """Spread starts around the first tip."""
        self.tip, self.base = tip, self.initial_rotation @ rotation_exp([0.0, 0.0, joints[1]])
        std = np.concatenate([np.full(3, self.settings.measurement_std), TURN_STD])
        self.starts = std * self.rng.standard_normal((PARTICLES, 6))
        self.log_weight = np.zeros(PARTICLES)
        self.shift, self.turn = np.zeros(3), np.eye(3)
        self._place_starts()

    def advance(self, d_insertion, d_rotation):
        """Go on along the way: an arc, turned as the base was."""
        step = arc(d_insertion, d_rotation, self.settings.curvature)
        self.shift = self.shift + self.turn @ step.shift
        self.turn = self.turn @ step.rotation

    def correct(self, tip, covariance, age):
        """Weigh the starts by how likely they make the tip."""
        if not np.all(np.isfinite(tip)):
            return
        if covariance is None:
            covariance = np.eye(3) * self.settings.measurement_std**2
        off = tip - self._places(self.shift - age * self.turn[:, 2])
        self.log_weight -= 0.5 * ((off @ np.linalg.inv(covariance)) * off).sum(axis=1)
        self.log_weight -= self.log_weight.max()
        share = self._share()
        if 1.0 / (share**2).sum() < 0.5 * PARTICLES:
            drawn = self.starts[self.rng.choice(PARTICLES, PARTICLES, p=share)]
            mean, spread = share @ self.starts, np.cov(self.starts.T, aweights=share)
            moved = self.rng.multivariate_normal(np.zeros(6), spread, PARTICLES, method="eigh")
            self.starts = mean + np.sqrt(1.0 - MOVED**2) * (drawn - mean) + MOVED * moved
            self.log_weight[:] = 0.0
            self._place_starts()

    def estimate(self):
        """Return the mean pose of all particles, and how they scatter about it."""
        share, places, turns = self._share(), self._places(self.shift), self.start_turn @ self.turn
        u, _, v = np.linalg.svd(np.tensordot(share, turns, 1))
        position, rotation = share @ places, u @ v
        off = angles_from_rotation(turns) - angles_from_rotation(rotation)
        off = (off + np.pi) % (2.0 * np.pi) - np.pi
        error = np.concatenate([places - position, off], axis=1)
        known = (share[:, None] * error).T @ error
        return pose_estimate(position, rotation, self.settings.curvature, known)

    def change_frame(self, T_new_old):
        """Express all in another target plane."""
        self.frame = T_new_old @ self.frame
        self._place_starts()

    def _place_starts(self):
        turn, starts = self.frame[:3, :3], self.starts
        self.start_place = (self.tip + starts[:, :3]) @ turn.T + self.frame[:3, 3]
        self.start_turn = turn @ self.base @ rotation_exp(starts[:, 3:])

    def _places(self, shift):
        return self.start_place + self.start_turn @ shift

    def _share(self):
        weight = np.exp(self.log_weight)
        return weight / weight.sum()
