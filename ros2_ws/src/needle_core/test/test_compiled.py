"""Where compiled code is kept, and when it is compiled anew."""

from __future__ import annotations

import os
import pwd
import random
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from needle_core import compiled


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    tmp_path.chmod(0o755)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir(mode=0o1777)
    package = tmp_path / "package"
    package.mkdir()
    return package


def test_it_is_kept_in_the_users_cache(package: Path, tmp_path: Path) -> None:
    folder = Path(compiled._cache_directory(package))
    assert folder.is_relative_to(tmp_path / "home" / ".cache")
    assert folder.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("name", ["NUMBA_CACHE_DIR", "XDG_CACHE_HOME"])
def test_it_is_kept_where_the_user_says(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv(name, str(tmp_path / "named"))
    assert Path(compiled._cache_directory(package)).is_relative_to(tmp_path / "named")


def test_without_a_home_nothing_is_kept(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("HOME")
    nowhere = SimpleNamespace(pw_dir="/dev/null/nobody")
    monkeypatch.setattr(pwd, "getpwuid", lambda _: nowhere)
    assert compiled._cache_directory(package) == ""
    assert not list((tmp_path / "tmp").iterdir())


CALLEE = """
from needle_core.compiled import compiled

@compiled
def callee(x):
    return x + {added}
"""
CALLER = """
from needle_core.compiled import compiled
from rooms.inner.callee import callee

@compiled
def caller(x):
    return callee(x)
"""


def test_an_edited_callee_in_another_room_is_compiled_anew(tmp_path: Path) -> None:
    rooms = tmp_path / "rooms"
    for folder in (rooms, rooms / "inner", rooms / "outer"):
        folder.mkdir()
        (folder / "__init__.py").touch()
    (rooms / "outer" / "caller.py").write_text(CALLER)
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}",
        # Sources of one second and size are told apart by nothing but their content.
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    said = []
    for added in (1, 2):
        (rooms / "inner" / "callee.py").write_text(CALLEE.format(added=added))
        script = "from rooms.outer.caller import caller; print(caller(0))"
        command = [sys.executable, "-c", script]
        said.append(subprocess.check_output(command, env=environment, text=True, timeout=60))
    assert list((tmp_path / "cache").rglob("*.nbi"))
    assert said == ["1\n", "2\n"]


@compiled.compiled
def _weighted(weight: float, one: float, other: float) -> float:
    return one + weight * (other - one)


def test_products_and_sums_are_rounded_as_pythons_are() -> None:
    draw = random.Random(4).gauss
    for _ in range(1000):
        numbers = draw(0.0, 1.0), draw(0.0, 1.0), draw(0.0, 1.0)
        assert _weighted(*numbers) == _weighted.__wrapped__(*numbers)  # type: ignore[attr-defined]
