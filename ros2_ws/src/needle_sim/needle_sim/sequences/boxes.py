"""Boxes of gel before two webcams, drawn at random, as the text of a calibration file."""

from __future__ import annotations

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from needle_sim.needle.se3 import FloatArray

_STREAM = 60
_SIZE = (640, 480)
_FOCAL_PX = (560.0, 1000.0)
_CENTRE_PX = 12.0  # of the principal point, from the image's middle, at most
_RADIAL, _TANGENTIAL = 0.12, 0.0005  # distortion: k1 at most, spread of p1 and p2
# At the needle; at 5.7 a needle of 1.3 mm is 7.4 px wide [px/m].
_SCALE = (4500.0, 7500.0)
_LEAST_AIR = 0.03  # before the wall [m]
_HALF_SIDES = (0.025, 0.048)  # of the gel, from the needle's axis to each wall [m]
_WALLS, _ACRYLIC = (0.003, 0.008), (1.485, 1.495)  # thickness [m], refractive index
_GEL = (1.33, 1.42)
_TILT = 0.005  # spread of a wall's normal off the axis [rad]
_BEFORE_ENTRY_PX = (15.0, 70.0)  # where the needle's entry is, from the image's border
_ASIDE = 0.012  # how far a camera is beside the middle of what it sees, at most [m]
_ROLL = 0.03  # spread of its roll [rad]


def draw_box(seed: int) -> str:
    """Return the calibration of two webcams, head-on before the top and one side of a box.

    Parameters
    ----------
    seed : int
        Same seed, same box; not negative.
    """
    rng = np.random.default_rng([seed, _STREAM])
    gel, acrylic = float(rng.uniform(*_GEL)), float(rng.uniform(*_ACRYLIC))
    wall = float(rng.uniform(*_WALLS))
    side = float(rng.choice([-1.0, 1.0]))
    cameras = {
        name: _camera(rng, np.array(axis), wall, acrylic, gel)
        for name, axis in (("left", [1.0, 0.0, 0.0]), ("right", [0.0, side, 0.0]))
    }
    return str(yaml.safe_dump(cameras, sort_keys=False, default_flow_style=None, width=140))


def _camera(
    rng: np.random.Generator, axis: FloatArray, wall: float, acrylic: float, gel: float
) -> dict[str, object]:
    inner, scale = float(rng.uniform(*_HALF_SIDES)), float(rng.uniform(*_SCALE))
    # What is behind refracting layers looks nearer.
    apparent = inner / gel + wall / acrylic
    focal = max(float(rng.uniform(*_FOCAL_PX)), scale * (_LEAST_AIR + apparent))
    along = np.array([0.0, 0.0, 1.0])
    seen = along * (_SIZE[0] / 2.0 - rng.uniform(*_BEFORE_ENTRY_PX)) / scale
    aside = np.append(rng.uniform(-_ASIDE, _ASIDE, 2), 0.0) * (1.0 - np.abs(axis))
    centre = seen + aside + (inner + wall + focal / scale - apparent) * axis
    centre[2] += rng.uniform(-_ASIDE, _ASIDE)
    ahead = seen - centre
    ahead /= np.linalg.norm(ahead)
    down = np.cross(ahead, along)
    down /= np.linalg.norm(down)
    upright = Rotation.from_matrix(np.stack([np.cross(down, ahead), down, ahead]))
    turned = Rotation.from_rotvec([0.0, 0.0, rng.normal(0.0, _ROLL)]) * upright
    normal = axis + rng.normal(0.0, _TILT, 3) * (1.0 - np.abs(axis))
    normal /= np.linalg.norm(normal)
    principal = np.array(_SIZE) / 2.0 + rng.uniform(-_CENTRE_PX, _CENTRE_PX, 2)
    lens = [rng.uniform(-_RADIAL, _RADIAL), 0.0, *rng.normal(0.0, _TANGENTIAL, 2), 0.0]
    matrix = [focal, 0.0, principal[0], 0.0, focal, principal[1], 0.0, 0.0, 1.0]
    return {
        "image_width": _SIZE[0],
        "image_height": _SIZE[1],
        "camera_matrix": {"rows": 3, "cols": 3, "data": _floats(matrix)},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": _floats(lens)},
        "T_optical_rig": {
            "translation": _floats(-turned.apply(centre)),
            "rotation": _floats(turned.as_quat()),
        },
        "window": {
            "point": _floats(seen + (inner + wall) * axis),
            "normal": _floats(normal),
            "layers": [{"thickness": wall, "refractive_index": acrylic}],
            "inside": gel,
        },
    }


def _floats(values: object) -> list[float]:
    return [float(value) for value in np.asarray(values).ravel()]
