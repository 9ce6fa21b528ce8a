"""Draws what two cameras would see of a calibration board, held freely and at a session's places.

python docs/examples/draw_board_images.py SESSION NEW_FOLDER

SESSION is a session file (docs/calibration.md), for cameras that look through one level surface.
NEW_FOLDER gets left, right and a copy of it.
"""

import shutil
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from needle_core.errors import UserError
from needle_sim.camera.stereo_rig import SimulatedCamera, load_stereo_rig
from needle_tracker.calibrating.calibration_session import load_session

FREE_VIEWS = 12
TRACKER = Path(__file__).resolve().parents[2] / "ros2_ws" / "src" / "needle_tracker"
# The boards that the calibration is tested on: their rays are traced by other code than its own.
sys.path.insert(0, str(TRACKER.parents[2] / "tests" / "shared"))
import synthetic_rig as boards  # noqa: E402

SQUARE, FINER = 80, 2  # [px] of a drawn square; how many times finer than the camera's it is drawn


def drawn(
    camera: SimulatedCamera, board: Any, pose: np.ndarray, under: bool, rng: np.random.Generator
) -> np.ndarray:
    """Return what a camera sees of a board; each cell of a fine mesh is mapped by its corners."""
    paper = boards.board_image(board, SQUARE, SQUARE)
    sides = (np.linspace(-1.0, n + 1.0, 4 * (n + 2) + 1) for n in (board.columns, board.rows))
    mesh = np.stack(np.meshgrid(*sides), axis=-1)
    flat = np.dstack([mesh * board.square, np.zeros(mesh.shape[:2])]).reshape(-1, 3)
    points = flat @ pose[:3, :3].T + pose[:3, 3]
    pixels = boards.pixels_of(camera, points, under).reshape(mesh.shape)
    target = ((pixels + 0.5) * FINER - 0.5).astype(np.float32)
    source = ((mesh + 1.0) * SQUARE - 0.5).astype(np.float32)
    size = np.array([camera.image_width, camera.image_height])
    image = np.full(size[::-1] * FINER, 130.0, np.float32)
    for i, j in np.ndindex(mesh.shape[0] - 1, mesh.shape[1] - 1):
        corners = [(i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)]
        here, there = (np.array([grid[at] for at in corners]) for grid in (source, target))
        low = np.maximum(np.floor(there.min(axis=0)).astype(int), 0)
        high = np.minimum(np.ceil(there.max(axis=0)).astype(int) + 1, size * FINER)
        if np.any(high <= low):
            continue
        warp = cv2.getPerspectiveTransform(here, there - low.astype(np.float32))
        width, height = (high - low).tolist()
        patch = cv2.warpPerspective(paper, warp, (width, height), borderValue=(255,))
        inside = np.zeros((height, width), np.uint8)
        cv2.fillConvexPoly(inside, np.round((there - low) * 16).astype(np.int32), (1,), shift=4)
        block = image[low[1] : high[1], low[0] : high[0]]
        block[inside > 0] = 30.0 + patch[inside > 0] * (190.0 / 255.0)
    image = cv2.GaussianBlur(image, (0, 0), 0.7 * FINER)
    small = cv2.resize(image, size.tolist(), interpolation=cv2.INTER_AREA)
    noisy = np.round(small + rng.normal(0.0, 2.0, small.shape))
    return np.asarray(np.clip(noisy, 0, 255), np.uint8)


if len(sys.argv) != 3:
    sys.exit("usage: python docs/examples/draw_board_images.py SESSION NEW_FOLDER")
given, folder = map(Path, sys.argv[1:])
if folder.exists():
    sys.exit(f"error: {folder} is there already: name another folder, or remove it")
try:
    session = load_session(given)
except UserError as error:
    sys.exit(f"error: {error}")
if not all(place.is_known for place in session.places.values()):
    sys.exit(f"error: session {given}: only places with an origin can be drawn")
rig, rng = load_stereo_rig(TRACKER / "config" / "calibration.yaml"), np.random.default_rng(0)
poses = [(f"free_{i}", boards.free_pose(rng), False) for i in range(FREE_VIEWS)]
for name, place in session.places.items():
    poses.append((name, boards.scatter(place, rng), place.under_surface))
for side, camera in (("left", rig.left), ("right", rig.right)):
    (folder / side).mkdir(parents=True)
    for name, pose, under in poses:
        image = drawn(camera, session.board, pose, under, rng)
        cv2.imwrite(str(folder / side / f"{name}.png"), image)
shutil.copy(given, folder / "session.yaml")
print(f"{folder}: left, right, session.yaml")
