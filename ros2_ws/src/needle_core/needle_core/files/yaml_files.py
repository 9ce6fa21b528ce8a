"""YAML and calibration files: duplicate keys are errors, and every error is one line."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from needle_core.errors import UserError
from needle_core.files.file_access import write_text


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """YAML loader that rejects duplicate keys, because the second would silently win."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> Any:
        keys: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in keys:
                    raise ValueError(f"duplicate key '{key.value}'{_where(key.start_mark)}")
                keys.add(key.value)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> Any:
    """Return the content of a YAML file; raise a `UserError` with the reason if that fails."""
    try:
        return load_yaml(read_text(path))
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error


def write_yaml(path: Path, content: Any, comments: Iterable[str]) -> None:
    """Write a YAML file with lines of comment at its top; a `UserError` has the reason if not."""
    text = yaml.safe_dump(content, default_flow_style=None, sort_keys=False, width=120)
    write_text(path, "".join(f"# {line}\n" for line in comments) + text)


def load_yaml(text: str) -> Any:
    """Return the content of a YAML document.

    Raises
    ------
    ValueError
        If the text is not YAML, or a key occurs twice.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        where = _where(getattr(error, "problem_mark", None))
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise ValueError(f"not YAML{where}: {problem}") from error


def _where(mark: Any) -> str:
    return f" in line {mark.line + 1}" if mark else ""


ROS = "a ROS camera_info of one camera"
KALIBR = "a Kalibr camera chain"
OPENCV = "an OpenCV FileStorage"
_SIGNS = {
    OPENCV: r"^%YAML:1\.0|!!opencv-|opencv[-_](matrix|storage)\b",
    KALIBR: r"^cam\d+\s*:",
    ROS: r"^(distortion_model|projection_matrix|rectification_matrix)\s*:",
}


def read_text(path: Path) -> str:
    """Return the text of a file; raise a `UserError` with the reason if that fails."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise UserError(f"{path}: cannot be read: {reason}") from error


def foreign_format(text: str) -> str:
    """Return which other tool wrote a calibration: ROS, KALIBR, OPENCV, or empty for none."""
    found = (kind for kind, sign in _SIGNS.items() if re.search(sign, text, re.MULTILINE))
    return next(found, "")


def read_calibration(path: Path) -> str:
    """Return the text of the rig's calibration file.

    Raises
    ------
    UserError
        If it cannot be read, or is the calibration of another tool.
    """
    text = read_text(path)
    if kind := foreign_format(text):
        raise UserError(
            f"calibration {path} is {kind}: it does not contain the places of rig and phantom; "
            "`calibrate_stereo --lenses` takes it, see docs/calibration.md"
        )
    return text
