"""package.xml lists the packages that its package imports, for rosdep and colcon."""

from __future__ import annotations

import ast
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

PACKAGES = sorted(Path(__file__).parents[2].glob("ros2_ws/src/*/package.xml"))
# Names of rosdep keys.
ROSDEP_KEYS = {
    "can": "python3-can",
    "cv2": "python3-opencv",
    "jinja2": "python3-jinja2",
    "markupsafe": "python3-markupsafe",
    "matplotlib": "python3-matplotlib",
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "scipy": "python3-scipy",
    "serial": "python3-serial",
    "tqdm": "python3-tqdm",
    "pytest": "python3-pytest",
    "yaml": "python3-yaml",
}
# Packages without a rosdep key, or of an extra with its own lock.
FROM_THE_LOCK_ALONE = {
    "canopen",
    "distributed",
    "drjit",
    "fastapi",
    "foxglove",
    "lz4",
    "mcap",
    "mitsuba",
    "nicegui",
    "pandas",
    "pyigtl",
    "rosbags",
    "uvicorn",
    "websockets",
    "zstandard",
}


def imports_of(folder: Path) -> set[str]:
    """Return the top-level names that the modules of a Python package import."""
    found = set()
    for module in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(module.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found.add(node.module.partition(".")[0])
    return found - sys.stdlib_module_names - {folder.name}


@pytest.mark.parametrize("manifest", PACKAGES, ids=lambda path: path.parent.name)
def test_a_manifest_names_what_the_package_imports(manifest: Path) -> None:
    root = ElementTree.parse(manifest).getroot()
    imported = imports_of(manifest.parent / manifest.parent.name) - FROM_THE_LOCK_ALONE
    required = {ROSDEP_KEYS.get(name, name) for name in imported}
    named = {element.text for element in root.iter("exec_depend")}
    assert required - named == set()
    assert not {name for name in named - required if name and name.startswith("python3-")}
