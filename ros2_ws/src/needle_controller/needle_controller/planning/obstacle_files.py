"""Obstacles from a YAML file.

frame: rig
spheres:
- {center: [0.0, 0.002, 0.05], radius: 0.004}
capsules:
- {start: [-0.02, 0.0, 0.07], end: [0.02, 0.0, 0.07], radius: 0.003}
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from needle_controller.model.target_plane import RIG
from needle_controller.planning.obstacles import Obstacle, Obstacles
from needle_core.errors import UserError
from needle_core.files.yaml_files import read_yaml

_KINDS = {"spheres": ("center", "center"), "capsules": ("start", "end")}


def read_obstacles(path: Path) -> Obstacles:
    """Return the obstacles of a file.

    Parameters
    ----------
    path : Path
        The file; lengths in it are in metres.

    Raises
    ------
    UserError
        A file that cannot be read, is no such YAML, is in another frame than `rig`, or holds an
        obstacle that is incomplete, not finite or out of bounds.
    """
    document = read_yaml(path)
    if not isinstance(document, dict):
        raise UserError(f"{path}: wants frame, spheres and capsules")
    unknown = sorted(str(key) for key in document if key not in {"frame", *_KINDS})
    if unknown:
        raise UserError(f"{path}: {unknown[0]} is not one of frame, {', '.join(_KINDS)}")
    if document.get("frame") != RIG:
        raise UserError(f"{path}: frame {document.get('frame')!r}, wants '{RIG}'")
    obstacles = []
    for kind, (first, last) in _KINDS.items():
        rows = document.get(kind) or []
        if not isinstance(rows, list):
            raise UserError(f"{path}: {kind} is no list")
        for number, row in enumerate(rows, start=1):
            name = f"{path}: {kind}, number {number}"
            if not isinstance(row, dict) or set(row) != {first, last, "radius"}:
                wanted = ", ".join(dict.fromkeys((first, last, "radius")))
                raise UserError(f"{name}: wants {wanted}")
            obstacles.append(
                Obstacle(
                    _point(f"{name}: {first}", row[first]),
                    _point(f"{name}: {last}", row[last]),
                    _number(f"{name}: radius", row["radius"]),
                )
            )
    try:
        return Obstacles(obstacles)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def _point(name: str, value: Any) -> tuple[float, float, float]:
    if not isinstance(value, list) or len(value) != 3:
        raise UserError(f"{name} = {value!r}, wants three numbers")
    x, y, z = (_number(name, number) for number in value)
    return x, y, z


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise UserError(f"{name} = {value!r}, wants a number")
    return float(value)
