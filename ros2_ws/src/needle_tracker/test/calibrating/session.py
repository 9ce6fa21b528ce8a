"""A recorded session on disk: drawn images of the board and the session file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from needle_tracker.calibrating.calibration_session import Place

from .synthetic_rig import BOARD, SIDES, TrueRig, free_pose, scatter


def place_entry(place: Place) -> dict[str, Any]:
    T = place.T_rig_board
    entry = {"origin": T[:3, 3].tolist(), "columns": T[:3, 0].tolist(), "rows": T[:3, 1].tolist()}
    return entry | {"under_surface": place.under_surface, "sigma": place.sigma}


def session_content(places: dict[str, Place]) -> dict[str, Any]:
    return {
        "board": {
            "columns": BOARD.columns,
            "rows": BOARD.rows,
            "square": BOARD.square,
            "marker": BOARD.marker,
            "dictionary": BOARD.dictionary,
        },
        "phantom": {"surface_height": 0.0175, "refractive_index": 1.33},
        "places": {name: place_entry(place) for name, place in places.items()},
    }


def record(folder: Path, rig: TrueRig, places: dict[str, Place], free: int, seed: int = 0) -> Path:
    """Draw a session into folder/{left,right}; returns its session file."""
    rng = np.random.default_rng(seed)
    poses = [(f"free_{i}", free_pose(rng), False) for i in range(free)]
    for name, place in places.items():
        poses.append((name, scatter(place.T_rig_board, place.sigma, rng), place.under_surface))
    for side in SIDES:
        (folder / side).mkdir(parents=True)
        for name, pose, under in poses:
            image = rig.draw(side, pose, under, rng)
            cv2.imwrite(str(folder / side / f"{name}.png"), image)
    path = folder / "session.yaml"
    path.write_text(yaml.safe_dump(session_content(places)))
    return path
