"""Random gel boxes in front of two webcams, as calibration files."""

from __future__ import annotations

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from needle_sim.needle.se3 import FloatArray

_STREAM = 60
_SIZE = (640, 480)
_FOCAL_PX = (560.0, 1000.0)
_CENTRE_PX = 12.0  # maximum offset of the principal point from the image centre
_RADIAL, _TANGENTIAL = 0.12, 0.0005  # distortion: maximum of k1, standard deviation of p1 and p2
# Scale at the needle: at 5700, a needle of 1.3 mm is 7.4 px wide [px/m].
_SCALE = (4500.0, 7500.0)
_MIN_AIR = 0.03  # distance from camera to wall [m]
_HALF_SIDES = (0.025, 0.048)  # distance from the needle's axis to each wall [m]
_WALLS, _ACRYLIC = (0.003, 0.008), (1.485, 1.495)  # thickness [m], refractive index
_GEL = (1.33, 1.42)
_TILT = 0.005  # standard deviation of a wall's tilt [rad]
_BEFORE_ENTRY_PX = (15.0, 70.0)  # distance of the needle's entry from the image border
_MAX_OFFSET = 0.012  # maximum distance of a camera from the centre of its view [m]
_ROLL = 0.03  # standard deviation of a camera's roll [rad]


def draw_box(seed: int) -> str:
    """Return the calibration of two webcams in front of the top and one side of a box.

    Parameters
    ----------
    seed : int
        Seed of the box, not negative.
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
    # Refraction reduces the apparent distance.
    apparent = inner / gel + wall / acrylic
    focal = max(float(rng.uniform(*_FOCAL_PX)), scale * (_MIN_AIR + apparent))
    along = np.array([0.0, 0.0, 1.0])
    view_centre = along * (_SIZE[0] / 2.0 - rng.uniform(*_BEFORE_ENTRY_PX)) / scale
    aside = np.append(rng.uniform(-_MAX_OFFSET, _MAX_OFFSET, 2), 0.0) * (1.0 - np.abs(axis))
    centre = view_centre + aside + (inner + wall + focal / scale - apparent) * axis
    centre[2] += rng.uniform(-_MAX_OFFSET, _MAX_OFFSET)
    ahead = view_centre - centre
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
            "point": _floats(view_centre + (inner + wall) * axis),
            "normal": _floats(normal),
            "layers": [{"thickness": wall, "refractive_index": acrylic}],
            "inside": gel,
        },
    }


def _floats(values: object) -> list[float]:
    return [float(value) for value in np.asarray(values).ravel()]
