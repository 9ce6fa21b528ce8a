"""Picture of a calibration: the rig with its boards."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from needle_core.errors import UserError
from needle_tracker.calibrating.rig_calibration import RigCalibration
from needle_tracker.optics.calibration import SIDES, Camera
from needle_tracker.optics.compiled_projection import pack_camera, pixel_ray
from needle_tracker.optics.window import Window

Array = NDArray[np.float64]

_COLOURS = {"left": "#1668b0", "right": "#d1701b"}
_BOARDS = {
    "free": ("board held freely", "#9aa0a8"),
    "surface": ("board of known place in air", "#1b1b1b"),
    "under": ("board under the surface", "#b03060"),
}
_MM = 1e3


def rig_figure(result: RigCalibration) -> Figure:
    """Return the rig from the side and along the needle: cameras, surface, boards, frustums."""
    figure = Figure(figsize=(9.0, 8.5), layout="constrained")
    planes = (2, "z (insertion) [mm]"), (1, "y [mm]")
    for axes, (axis, label) in zip(figure.subplots(1, 2), planes, strict=True):
        axes.plot(0, 0, "k+", markersize=12, label="rig (entry point)")
        for i, view in enumerate(result.model.views):
            outline, (name, colour) = _MM * _outline(result, i), _BOARDS[view.kind]
            axes.plot(outline[:, axis], outline[:, 0], color=colour, linewidth=1.5, label=name)
        for side, camera in result.calibration.cameras.items():
            name, colour = f"{side} camera", _COLOURS[side]
            centre = _MM * camera.centre
            axes.plot(centre[axis], centre[0], "o", color=colour, label=name)
            _draw_frustum(axes, camera, axis, colour)
            _draw_face(axes, camera.window, axis)
        axes.set(aspect="equal", xlabel=label, ylabel="x (up) [mm]")
        axes.grid(color="#e4e6ea")
    # The legend names each thing once; what has no name begins with _.
    named = {line.get_label(): line for axes in figure.axes for line in axes.get_lines()}
    shown = [line for name, line in named.items() if not str(name).startswith("_")]
    figure.legend(handles=shown, loc="outside lower center", ncols=4, fontsize=8)
    figure.suptitle("The rig as calibrated")
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG.

    Raises
    ------
    UserError
        If it cannot be written.
    """
    try:
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error


def _outline(result: RigCalibration, view: int) -> Array:
    points = np.concatenate([result.model.views[view].corners(side).points for side in SIDES])
    low, high = points.min(axis=0), points.max(axis=0)
    ring = np.array([low, [high[0], low[1], 0], high, [low[0], high[1], 0], low])
    pose = result.model.board_poses(result.fit.parameters)[view]
    return np.asarray(ring @ pose[:3, :3].T + pose[:3, 3])


def _draw_face(axes: Any, window: Window, axis: int) -> None:
    """Draw a window's outer face where it is seen edge on."""
    along, up = window.normal[axis], window.normal[0]
    if np.hypot(along, up) > 0.5:
        place = (_MM * window.point[axis], _MM * window.point[0])
        axes.axline(place, (place[0] + up, place[1] - along), color="#2e9d55", label="window")


def _draw_frustum(axes: Any, camera: Camera, axis: int, colour: str) -> None:
    """Draw the rays of the image's corners, down to the window if they look at it."""
    width, height = float(camera.width), float(camera.height)
    packed, end, direction = pack_camera(camera), np.empty(3), np.empty(3)
    for corner in ((0.0, 0.0), (width, 0.0), (width, height), (0.0, height)):
        pixel_ray(packed, np.array(corner), end, direction)
        ray = _MM * np.stack([camera.centre, end])
        axes.plot(ray[:, axis], ray[:, 0], color=colour, linewidth=0.8)
