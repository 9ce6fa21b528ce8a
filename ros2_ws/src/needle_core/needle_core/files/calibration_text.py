"""The text of a calibration file; calibrations of other tools are told from the rig's own."""

from __future__ import annotations

import re
from pathlib import Path

from needle_core.errors import UserError

ROS = "a ROS camera_info of one camera"
KALIBR = "a Kalibr camera chain"
OPENCV = "an OpenCV FileStorage"
_SIGNS = {
    OPENCV: r"^%YAML:1\.0|!!opencv-|opencv[-_](matrix|storage)\b",
    KALIBR: r"^cam\d+\s*:",
    ROS: r"^(distortion_model|projection_matrix|rectification_matrix)\s*:",
}


def read_text(path: Path) -> str:
    """Return the text of a file; a `UserError` says why it cannot be read."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise UserError(f"{path}: cannot be read: {reason}") from error


def foreign_format(text: str) -> str:
    """Return which other tool's calibration a text is: ROS, KALIBR, OPENCV or empty."""
    signs = _SIGNS.items()
    return next((kind for kind, sign in signs if re.search(sign, text, re.MULTILINE)), "")


def read_calibration(path: Path) -> str:
    """Return the text of the rig's calibration file.

    Raises
    ------
    UserError
        Unreadable, or the calibration of another tool.
    """
    text = read_text(path)
    if kind := foreign_format(text):
        raise UserError(
            f"calibration {path} is {kind}: it does not say where rig and phantom are; "
            "`calibrate_stereo --lenses` takes it, see docs/calibration.md"
        )
    return text
