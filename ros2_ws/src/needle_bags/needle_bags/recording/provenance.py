"""Versions of the code that made a run, and of what it stands on."""

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
    """Return the ROS distribution; the workspace is built for Jazzy where nothing else is said."""
    return os.environ.get("ROS_DISTRO") or _DISTRIBUTION


def versions() -> dict[str, str]:
    """Return name to version of Python, the operating system, ROS and the packages in use."""
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
    """Return the git commit of the sources, `-dirty` where they differ, or `unknown`."""
    # Links are followed, so that an installed link names its checkout.
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
