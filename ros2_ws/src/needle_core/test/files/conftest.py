"""A bag for tests that damage it."""

from __future__ import annotations

from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin

from .made_bags import rosbag


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A bag of numbered messages."""
    return rosbag(tmp_path / "bag", StoragePlugin.MCAP)
