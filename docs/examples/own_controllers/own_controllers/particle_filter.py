"""An estimator: a particle filter with the needle's own model, for one needle or for many.

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
        self.shape, needles = tip.shape[:-1], int(np.prod(tip.shape[:-1]))
        base = np.zeros((needles, 3))
        base[:, 2] = joints[..., 1].ravel()
        self.tip, self.base = tip.reshape(-1, 3), self.initial_rotation @ rotation_exp(base)
        std = np.concatenate([np.full(3, self.settings.measurement_std), TURN_STD])
        self.starts = std * self.rng.standard_normal((needles, PARTICLES, 6))
        self.log_weight = np.zeros((needles, PARTICLES))
        self.shift, self.turn = np.zeros((needles, 3)), np.tile(np.eye(3), (needles, 1, 1))
        self._place_starts()

    def advance(self, d_insertion, d_rotation):
        """Go on along the way: an arc, turned as the base was."""
        length, turned = (np.broadcast_to(d, self.shape).ravel() for d in (d_insertion, d_rotation))
        step = arc(length, turned, self.settings.curvature)
        self.shift = self.shift + (self.turn @ step.shift[..., None])[..., 0]
        self.turn = self.turn @ step.rotation

    def correct(self, tip, covariance, age):
        """Weigh the starts by how likely they make the tip."""
        if covariance is None:
            covariance = np.eye(3) * self.settings.measurement_std**2
        known = np.linalg.inv(np.broadcast_to(covariance, (*self.shape, 3, 3)).reshape(-1, 3, 3))
        since = np.broadcast_to(age, self.shape).ravel()[:, None] * self.turn[:, :, 2]
        off = tip.reshape(-1, 1, 3) - self._places(self.shift - since)
        off = np.nan_to_num(off)  # a tip that was not found weighs all alike
        self.log_weight -= 0.5 * ((off @ known) * off).sum(axis=2)
        self.log_weight -= self.log_weight.max(axis=1, keepdims=True)
        share = self._share()
        for n in np.flatnonzero(1.0 / (share**2).sum(axis=1) < 0.5 * PARTICLES):
            drawn = self.starts[n, self.rng.choice(PARTICLES, PARTICLES, p=share[n])]
            mean, spread = share[n] @ self.starts[n], np.cov(self.starts[n].T, aweights=share[n])
            moved = self.rng.multivariate_normal(np.zeros(6), spread, PARTICLES, method="eigh")
            self.starts[n] = mean + np.sqrt(1.0 - MOVED**2) * (drawn - mean) + MOVED * moved
            self.log_weight[n] = 0.0
        self._place_starts()

    def estimate(self):
        """Return the mean pose of all particles, and how they scatter about it."""
        share, places = self._share()[..., None], self._places(self.shift)
        u, _, v = np.linalg.svd((share[..., None] * self.start_turn).sum(axis=1) @ self.turn)
        position, rotation = (share * places).sum(axis=1), u @ v
        angles = angles_from_rotation(self.start_turn @ self.turn[:, None])
        off = (angles - angles_from_rotation(rotation)[:, None] + np.pi) % (2.0 * np.pi) - np.pi
        error = np.concatenate([places - position[:, None], off], axis=2)
        known = (share * error).swapaxes(1, 2) @ error
        rows = [np.reshape(a, (*self.shape, *a.shape[1:])) for a in (position, rotation, known)]
        return pose_estimate(rows[0], rows[1], self.settings.curvature, rows[2])

    def change_frame(self, T_new_old):
        """Express all in another target plane."""
        self.frame = T_new_old @ self.frame
        self._place_starts()

    def _place_starts(self):
        turn, starts = self.frame[:3, :3], self.starts
        self.start_place = (self.tip[:, None] + starts[..., :3]) @ turn.T + self.frame[:3, 3]
        self.start_turn = turn @ self.base[:, None] @ rotation_exp(starts[..., 3:])

    def _places(self, shift):
        return self.start_place + (self.start_turn @ shift[:, None, :, None])[..., 0]

    def _share(self):
        weight = np.exp(self.log_weight)
        return weight / weight.sum(axis=1, keepdims=True)
