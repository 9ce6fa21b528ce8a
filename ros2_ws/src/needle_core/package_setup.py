"""Contents of an installation: package by package for colcon, or all of it for pip."""

from __future__ import annotations

import ast
import os
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

_PACKAGE_DATA = {"": ["py.typed", "*.onnx", "*.xml", "static/*"]}


def set_up(script: str) -> None:
    """Install one package as described by its package.xml and `executables.py`.

    Parameters
    ----------
    script : str
        The package's `setup.py`, or colcon's link to it.
    """
    folder = Path(script).resolve().parent
    manifest = {one.tag: one for one in ElementTree.parse(folder / "package.xml").iter()}
    texts = {tag: one.text or "" for tag, one in manifest.items()}
    setup(
        name=folder.name,
        version=texts["version"],
        packages=find_packages(include=[folder.name, f"{folder.name}.*"]),
        package_data=_PACKAGE_DATA,
        data_files=data_files(folder, Path()),
        zip_safe=False,
        maintainer=texts["maintainer"],
        maintainer_email=manifest["maintainer"].get("email"),
        description=texts["description"],
        license=texts["license"],
        entry_points={"console_scripts": executables(folder), "pytest11": test_plugins(folder)},
    )


def set_up_all(root: Path) -> None:
    """Install all packages of a checkout as one distribution, in addition to pyproject.toml.

    Parameters
    ----------
    root : Path
        The checkout.
    """
    folders = sorted(path.parent for path in root.glob("ros2_ws/src/*/package.xml"))
    scripts = [line for folder in folders for line in executables(folder)]
    setup(
        packages=[
            package
            for folder in folders
            for package in find_packages(folder, include=[folder.name, f"{folder.name}.*"])
        ],
        package_dir={
            folder.name: os.path.relpath(folder / folder.name, root) for folder in folders
        },
        package_data=_PACKAGE_DATA,
        data_files=[
            files for folder in folders for files in data_files(folder, folder.relative_to(root))
        ],
        zip_safe=False,
        entry_points={
            "console_scripts": ["ros2 = needle_core.commands.small_ros2:main", *scripts],
            "pytest11": [line for folder in folders for line in test_plugins(folder)],
        },
    )


def data_files(folder: Path, where: Path) -> list[tuple[str, list[str]]]:
    """Return the data files of a package, and where ament and ROS look for them.

    Parameters
    ----------
    folder : Path
        The package.
    where : Path
        The same from the folder in which the install script runs.
    """
    share = f"share/{folder.name}"
    found = {
        "share/ament_index/resource_index/packages": folder.glob("resource/*"),
        share: folder.glob("package.xml"),
        f"{share}/config": folder.glob("config/*"),
        f"{share}/launch": folder.glob("launch/*.py"),
    }
    return [
        (place, sorted(str(where / file.relative_to(folder)) for file in files))
        for place, files in found.items()
    ]


def executables(folder: Path) -> list[str]:
    """Return the entry points that a package's `executables.py` defines; none where it has none."""
    module = folder / folder.name / "executables.py"
    if not module.exists():
        return []
    names = [
        target.id
        for statement in ast.parse(module.read_text("utf-8")).body
        if isinstance(statement, ast.Assign)
        for target in statement.targets
        if isinstance(target, ast.Name)
    ]
    return [f"{name} = {folder.name}.executables:{name}" for name in names]


def test_plugins(folder: Path) -> list[str]:
    """Return the entry point of a package's conformance kit for pytest; none where it has none."""
    kit = folder / folder.name / "conformance" / "plugin.py"
    return [f"{folder.name} = {folder.name}.conformance.plugin"] if kit.exists() else []
