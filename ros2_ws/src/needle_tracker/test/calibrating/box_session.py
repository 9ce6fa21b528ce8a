"""A calibration of a box with a window for each camera: what is held where, seen by a known rig."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from needle_tracker.calibrating.calibration_session import Place
from needle_tracker.calibrating.charuco import CharucoBoard
from needle_tracker.calibrating.rig_model import BoardView
from needle_tracker.optics.window import Layer, Window

from .session import draw, session_content
from .synthetic_rig import SIDES, TrueRig

Array = NDArray[np.float64]

SMALL_BOARD = CharucoBoard(columns=12, rows=5, square=0.008, marker=0.006)
# As a ruler and a data sheet tell it: faces to a millimetre, level and plumb.
_WALL = (Layer(5e-3, 1.49),)
GIVEN = (
    Window(np.array([0.0235, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), _WALL, 1.34),
    Window(np.array([0.0, 0.059, 0.0]), np.array([0.0, 1.0, 0.0]), _WALL, 1.34),
)


def _facing(up: Array) -> Array:
    """Rotation of a board with its print towards `up`, its columns along the needle."""
    columns = np.array([0.0, 0.0, 1.0])
    columns = columns - (columns @ up) * up
    columns /= np.linalg.norm(columns)
    return np.stack([columns, np.cross(-up, columns), -up], axis=-1)


def _held(rotation: Array, middle: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    half = np.array([SMALL_BOARD.size[0] / 2.0, SMALL_BOARD.size[1] / 2.0, 0.0])
    pose[:3, 3] = middle - rotation @ half
    return pose


def pose_in_air(number: int, rng: np.random.Generator) -> Array:
    """T_rig_board of a board held before one window, tilted: even numbers above, odd ones aside."""
    up, across = np.eye(3)[number % 2], np.eye(3)[1 - number % 2]
    tilt, round_about = np.deg2rad(rng.uniform(25.0, 50.0)), rng.uniform(0.0, 2.0 * np.pi)
    axis = np.cos(round_about) * across + np.sin(round_about) * np.array([0.0, 0.0, 1.0])
    spin = Rotation.from_rotvec(np.deg2rad(rng.uniform(-60.0, 60.0)) * up)
    turn = Rotation.from_rotvec(tilt * axis) * spin
    middle = (rng.uniform(0.07, 0.20) + 0.04 * (number % 2)) * up + rng.uniform(
        -0.03, 0.03
    ) * across
    middle[2] += rng.uniform(0.035, 0.09)
    return _held(turn.as_matrix() @ _facing(up), middle)


DIAGONAL = np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0)
PLACE = Place(_held(_facing(DIAGONAL), np.array([0.0, 0.0, 0.0625])), under_surface=True)
"""Where the board stands in the box: half-way between both views, about the needle's axis."""
IN_BOX = Place(np.eye(4), under_surface=True, sigma=np.inf)


def pose_in_box(rng: np.random.Generator) -> Array:
    """T_rig_board of a board held freely in the box, seen by both cameras."""
    turn = Rotation.from_rotvec(np.deg2rad(rng.uniform(-12.0, 12.0, 3)))
    shift = rng.uniform([-0.001, -0.012, 0.05], [0.001, 0.008, 0.075])
    return _held(turn.as_matrix() @ _facing(DIAGONAL), shift)


def session_poses(air: int, box: int, seed: int) -> list[tuple[str, Array, Place | None]]:
    """What a session shows: boards before the windows, one that stands in the box, held in it."""
    rng = np.random.default_rng(seed)
    poses: list[tuple[str, Array, Place | None]] = [
        (f"air_{i:02d}", pose_in_air(i, rng), None) for i in range(air)
    ]
    poses.append(("stand", PLACE.T_rig_board, PLACE))
    return poses + [(f"box_{i:02d}", pose_in_box(rng), IN_BOX) for i in range(box)]


def take_in_box(rig: TrueRig, air: int, box: int, seed: int, noise: float = 0.1) -> list[BoardView]:
    """The session's corners, with noise."""
    rng = np.random.default_rng([seed, 1])
    return [
        rig.view(name, pose, place, rng, noise)
        for name, pose, place in session_poses(air, box, seed)
    ]


def box_content() -> dict[str, Any]:
    """The session file: windows for each camera in place of the phantom."""
    content = session_content({"stand": PLACE, "box_*": IN_BOX}, SMALL_BOARD)
    del content["phantom"]
    for side, window in zip(SIDES, GIVEN, strict=True):
        layers = [
            {"thickness": layer.thickness, "refractive_index": layer.refractive_index}
            for layer in window.layers
        ]
        content[side] = {
            "window": {
                "point": window.point.tolist(),
                "normal": window.normal.tolist(),
                "layers": layers,
                "inside": window.inside,
            }
        }
    return content


def record_box(folder: Path, rig: TrueRig, air: int, box: int, seed: int = 0) -> Path:
    """Draw the session into folder/{left,right}; returns its session file."""
    poses = session_poses(air, box, seed)
    draw(folder, rig, [(name, pose, place is not None) for name, pose, place in poses], seed)
    path = folder / "session.yaml"
    path.write_text(yaml.safe_dump(box_content()))
    return path
