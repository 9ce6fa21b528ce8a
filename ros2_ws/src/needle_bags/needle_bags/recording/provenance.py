"""Versions of the code of a run and of its dependencies."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path

_PACKAGES = (
    "needle_core needle_tracker needle_controller needle_device_driver needle_sim "
    "needle_bags rclpy numpy scipy opencv-python-headless mcap rosbags matplotlib"
)
_DISTRIBUTION = "jazzy"


def distribution() -> str:
    """Return the ROS distribution, Jazzy by default."""
    return os.environ.get("ROS_DISTRO") or _DISTRIBUTION


def versions() -> dict[str, str]:
    """Return the versions of Python, the operating system, ROS and the packages, by name."""
    found = {
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "ros_distro": distribution(),
        "rmw": os.environ.get("RMW_IMPLEMENTATION") or "default",
    }
    for name in _PACKAGES.split():
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def commit() -> str:
    """Return the git commit of the sources, with `-dirty` if modified, or `unknown`."""
    # Follow symlinks of the installation to the checkout.
    folder = str(Path(__file__).resolve().parent)
    try:
        answer = subprocess.run(
            ["git", "-C", folder, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            capture_output=True,
            text=True,
            timeout=5.0,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return answer.stdout.strip()
