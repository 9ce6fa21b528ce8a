"""A bare metal needle: its shaft mirrors a lamp where the angles fit, and the dark room elsewhere.

A cylinder mirrors the lamp along the line where its normal halves the angle between lamp and
camera. Where the shaft bends away from that, the bright core fades and the needle is dark up to its
end, in one view sooner than in the other. Refraction does not turn the light here: that moves where
the core fades, not what it looks like.
"""

from __future__ import annotations

import numpy as np

from needle_sim.camera.scenarios import Metal
from needle_sim.needle.se3 import FloatArray

_LAMP_SIDE, _LAMP_HEIGHT, _LAMP_ALONG = (0.1, 0.3), 0.4, (0.02, 0.1)


def place_lamp(rng: np.random.Generator) -> FloatArray:
    """Return where a run's lamp stands: to either side above the phantom, shape (3,) [m]."""
    side = float(rng.choice([-1.0, 1.0])) * rng.uniform(*_LAMP_SIDE)
    return np.array([_LAMP_HEIGHT, side, rng.uniform(*_LAMP_ALONG)])


def mirrored(
    line: FloatArray, camera: FloatArray, lamp: FloatArray, metal: Metal
) -> tuple[FloatArray, FloatArray]:
    """Return how much of the lamp a shaft mirrors, and where across it.

    Parameters
    ----------
    line : ndarray, shape (M, 3)
        Its middle line in `rig` [m].
    camera, lamp : ndarray, shape (3,)
        Where they are in `rig` [m].
    metal : Metal
        Of the shaft.

    Returns
    -------
    share : ndarray, shape (M,)
        Of the lamp's light, 0 to 1.
    place : ndarray, shape (M,)
        Of the core, over the shaft's radius, positive towards `cross(ahead, to camera)`.
    """
    ahead = np.gradient(line, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    to_camera, to_lamp = camera - line, lamp - line
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    to_lamp /= np.linalg.norm(to_lamp, axis=1, keepdims=True)
    between = to_camera + to_lamp
    between /= np.linalg.norm(between, axis=1, keepdims=True)
    off = np.sum(between * ahead, axis=1)
    normal = between - off[:, np.newaxis] * ahead
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    sideways = np.cross(ahead, to_camera)
    sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
    share = np.exp(-((off / metal.spread) ** 2))
    return np.asarray(share), np.asarray(np.sum(normal * sideways, axis=1))
