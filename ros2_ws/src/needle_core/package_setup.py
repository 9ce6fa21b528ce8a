"""Install script of every package of the workspace: each `setup.py` calls it for its own."""

from __future__ import annotations

import ast
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup


def set_up(script: str) -> None:
    """Install a package as its package.xml and its `executables.py` say.

    Parameters
    ----------
    script : str
        The package's `setup.py`, or colcon's link to it.
    """
    folder = Path(script).resolve().parent
    name = folder.name
    manifest = {one.tag: one for one in ElementTree.parse(folder / "package.xml").iter()}
    said = {tag: one.text or "" for tag, one in manifest.items()}
    setup(
        name=name,
        version=said["version"],
        packages=find_packages(include=[name, f"{name}.*"]),
        package_data={"": ["py.typed", "*.onnx", "*.xml", "static/*"]},
        data_files=[
            ("share/ament_index/resource_index/packages", [f"resource/{name}"]),
            (f"share/{name}", ["package.xml"]),
            (f"share/{name}/config", list(map(str, Path("config").glob("*")))),
            (f"share/{name}/launch", list(map(str, Path("launch").glob("*.py")))),
        ],
        zip_safe=False,
        maintainer=said["maintainer"],
        maintainer_email=manifest["maintainer"].get("email"),
        description=said["description"],
        license=said["license"],
        entry_points={"console_scripts": executables(folder / name / "executables.py")},
    )


def executables(module: Path) -> list[str]:
    """Return the entry points that a package's `executables.py` defines; none where it has none."""
    if not module.exists():
        return []
    names = [
        target.id
        for statement in ast.parse(module.read_text("utf-8")).body
        if isinstance(statement, ast.Assign)
        for target in statement.targets
        if isinstance(target, ast.Name)
    ]
    return [f"{name} = {module.parent.name}.executables:{name}" for name in names]
