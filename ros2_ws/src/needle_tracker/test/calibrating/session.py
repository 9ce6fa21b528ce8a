"""A recorded session on disk: drawn images of the board and the session file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from needle_tracker.calibrating.calibration_session import Place
from needle_tracker.calibrating.charuco import CharucoBoard

from .synthetic_rig import BOARD, SIDES, TrueRig, free_pose, scatter

Array = NDArray[np.float64]


def place_entry(place: Place) -> dict[str, Any]:
    if not place.is_known:
        return {"under_surface": True}
    T = place.T_rig_board
    entry = {"origin": T[:3, 3].tolist(), "columns": T[:3, 0].tolist(), "rows": T[:3, 1].tolist()}
    return entry | {"under_surface": place.under_surface, "sigma": place.sigma}


def session_content(places: dict[str, Place], board: CharucoBoard = BOARD) -> dict[str, Any]:
    return {
        "board": {
            "columns": board.columns,
            "rows": board.rows,
            "square": board.square,
            "marker": board.marker,
            "dictionary": board.dictionary,
        },
        "phantom": {"surface_height": 0.0175, "refractive_index": 1.33},
        "places": {name: place_entry(place) for name, place in places.items()},
    }


def draw(folder: Path, rig: TrueRig, poses: list[tuple[str, Array, bool]], seed: int) -> None:
    """Draw boards into folder/{left,right}: name, T_rig_board, whether seen through the windows."""
    rng = np.random.default_rng(seed)
    for side in SIDES:
        (folder / side).mkdir(parents=True)
        for name, pose, under in poses:
            image = rig.draw(side, pose, under, rng)
            cv2.imwrite(str(folder / side / f"{name}.png"), image)


def record(folder: Path, rig: TrueRig, places: dict[str, Place], free: int, seed: int = 0) -> Path:
    """Draw a session into folder/{left,right}; returns its session file."""
    rng = np.random.default_rng(seed)
    poses = [(f"free_{i}", free_pose(rng), False) for i in range(free)]
    for name, place in places.items():
        poses.append((name, scatter(place.T_rig_board, place.sigma, rng), place.under_surface))
    draw(folder, rig, poses, seed + 1)
    path = folder / "session.yaml"
    path.write_text(yaml.safe_dump(session_content(places)))
    return path
