"""package.xml and the import contracts list the imports of each package."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = sorted(ROOT.glob("ros2_ws/src/*/package.xml"))
ROS = re.compile(r"rclpy|rosidl_.*|launch|launch_ros|.*_msgs|.*_interfaces|std_srvs")
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


def test_the_contracts_name_every_package_and_all_imported_packages_of_ros() -> None:
    text = (ROOT / "pyproject.toml").read_text("utf-8")
    protected = text.partition("\nprotected_modules = [")[2].partition("]")[0]
    imported = {
        name
        for manifest in PACKAGES
        for name in imports_of(manifest.parent / manifest.parent.name)
        if ROS.fullmatch(name)
    }
    assert set(re.findall(r'"(.+?)"', protected)) == {"*.ros", *imported}
    for manifest in PACKAGES:
        # root_packages, and at least one contract on its layers and one on its neighbours
        assert text.count(f'"{manifest.parent.name}"') >= 3
