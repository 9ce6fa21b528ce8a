"""Writes the calibration file that the tracker and the simulated rig read."""

from __future__ import annotations

from pathlib import Path

from scipy.spatial.transform import Rotation

from needle_common.errors import UserError
from needle_tracker.optics.calibration import SIDES, StereoCalibration
from needle_tracker.optics.window import Window


def calibration_text(calibration: StereoCalibration, comments: list[str]) -> str:
    """Return the YAML text of a calibration.

    Parameters
    ----------
    calibration : StereoCalibration
        What to write.
    comments : list of str
        Lines to put before it.
    """
    surface = calibration.surface
    lines = [f"# {line}" for line in comments]
    if surface is not None:
        lines.append(
            f"phantom: {{surface_height: {surface.point[0]:.9f}, "
            f"refractive_index: {surface.inside:.6f}}}"
        )
    for side in SIDES:
        camera = calibration.left if side == "left" else calibration.right
        matrix = ", ".join(f"{value:.4f}" for value in camera.camera_matrix.ravel())
        lens = ", ".join(f"{value:.9f}" for value in camera.distortion)
        translation = ", ".join(f"{value:.9f}" for value in camera.T_optical_rig[:3, 3])
        quaternion = Rotation.from_matrix(camera.T_optical_rig[:3, :3]).as_quat()
        rotation = ", ".join(f"{value:.12f}" for value in quaternion)
        lines += [
            f"{side}:",
            f"  image_width: {camera.width}",
            f"  image_height: {camera.height}",
            f"  camera_matrix: {{rows: 3, cols: 3, data: [{matrix}]}}",
            "  distortion_model: plumb_bob",
            f"  distortion_coefficients: {{rows: 1, cols: 5, data: [{lens}]}}",
            "  T_optical_rig:",
            f"    translation: [{translation}]",
            f"    rotation: [{rotation}]",
        ]
        if surface is None:
            lines += _window_lines(camera.window)
    return "\n".join(lines) + "\n"


def _window_lines(window: Window) -> list[str]:
    point = ", ".join(f"{value:.9f}" for value in window.point)
    normal = ", ".join(f"{value:.12f}" for value in window.normal)
    layers = ", ".join(
        f"{{thickness: {layer.thickness:.9f}, refractive_index: {layer.refractive_index:.6f}}}"
        for layer in window.layers
    )
    return [
        "  window:",
        f"    point: [{point}]",
        f"    normal: [{normal}]",
        f"    layers: [{layers}]",
        f"    inside: {window.inside:.6f}",
    ]


def save_calibration(path: Path, calibration: StereoCalibration, comments: list[str]) -> None:
    """Write a calibration file.

    Raises
    ------
    UserError
        If it cannot be written.
    """
    try:
        path.write_text(calibration_text(calibration, comments), encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error
