"""A checkout without packages."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[3] / "scripts"


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Return a checkout in a path with a space, without packages."""
    root = tmp_path / "with a space"
    shutil.copytree(SCRIPTS, root / "scripts", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("requirements.lock", "requirements-ros.lock"):
        (root / name).write_text("setuptools==1 \\\n    --hash=sha256:0\n")
    package = root / "ros2_ws" / "src" / "needle_one"
    (package / "config").mkdir(parents=True)
    for name in ("package.xml", "setup.py", "setup.cfg"):
        (package / name).write_text("")
    return root
