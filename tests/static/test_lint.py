"""Static checks of all packages, scripts and tests: style, types and import contracts."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
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


@on_typed_numpy
def test_types() -> None:
    passes("-m", "mypy")


def test_import_walls() -> None:
    code = "from importlinter.cli import lint_imports_command as main; main()"
    passes("-c", code, "--no-cache")
