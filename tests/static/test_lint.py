"""Static checks of all packages, scripts and tests: style, types and import contracts."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = sorted(path.parent for path in (ROOT / "ros2_ws/src").glob("*/package.xml"))
# Type stubs differ between releases of numpy.
on_typed_numpy = pytest.mark.skipif(
    not np.__version__.startswith("2.4."),
    reason=f"types are checked, for Python 3.10 too, where numpy is 2.4; this is {np.__version__}",
)


def passes(*arguments: str | Path) -> None:
    done = subprocess.run(
        [sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"


@pytest.mark.parametrize("how", [("check",), ("format", "--check")])
def test_style(how: tuple[str, ...]) -> None:
    passes("-m", "ruff", *how)


# One package at a time: every package has a test folder, with files of the same name in several.
# The first must read the types of the libraries, which takes minutes on a busy machine.
@on_typed_numpy
@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.name)
def test_types_of_a_package(package: Path) -> None:
    folders = [package / package.name, package / "test"]
    passes("-m", "mypy", *(folder for folder in folders if folder.is_dir()))


@on_typed_numpy
def test_types_of_scripts_tests_and_an_example_that_uses_them() -> None:
    example = ROOT / "docs/examples/draw_board_images.py"
    passes("-m", "mypy", ROOT / "scripts/lib", ROOT / "tests", example)


def test_import_walls() -> None:
    code = "from importlinter.cli import lint_imports_command as main; main()"
    passes("-c", code, "--no-cache")
