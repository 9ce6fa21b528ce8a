"""exp_twist, compared with scipy's matrix exponential for all angles."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from needle_sim.needle.se3 import exp_twist

ANGLES = (0.0, 1e-12, 1e-3, 0.2999, 0.3001, 3.1, 6.0)


def exponential(twist: np.ndarray) -> np.ndarray:
    v, w = twist[:3], twist[3:]
    rows = [[0, -w[2], w[1], v[0]], [w[2], 0, -w[0], v[1]], [-w[1], w[0], 0, v[2]], [0, 0, 0, 0]]
    return np.asarray(expm(np.array(rows)))


def test_twists_of_any_angle_one_or_many_have_the_matrix_exponential() -> None:
    rng = np.random.default_rng(1)
    twists = rng.standard_normal((10, len(ANGLES), 6))
    twists[..., 3:] /= np.linalg.norm(twists[..., 3:], axis=-1, keepdims=True)
    twists[..., 3:] *= np.array(ANGLES)[:, np.newaxis]
    together = exp_twist(twists)
    for index in np.ndindex(10, len(ANGLES)):
        np.testing.assert_allclose(together[index], exponential(twists[index]), rtol=0, atol=3e-14)
    np.testing.assert_allclose(exp_twist(twists[0, 1]), together[0, 1], rtol=0, atol=1e-15)
