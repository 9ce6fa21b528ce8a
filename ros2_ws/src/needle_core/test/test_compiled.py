"""The cache of compiled code, and its invalidation."""

from __future__ import annotations

import random
from pathlib import Path

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


def test_compiled_code_is_cached_in_the_users_cache_or_a_chosen_folder(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Path(compiled._cache_directory(package))
    assert folder.is_relative_to(tmp_path / "home" / ".cache")
    assert folder.stat().st_mode & 0o777 == 0o700
    for name in ("XDG_CACHE_HOME", "NUMBA_CACHE_DIR"):
        monkeypatch.setenv(name, str(tmp_path / name))
        compiled._cache_directory.cache_clear()
        assert Path(compiled._cache_directory(package)).is_relative_to(tmp_path / name)


def test_code_edited_in_any_folder_of_its_package_is_recompiled(package: Path) -> None:
    room = package / "inner"
    room.mkdir()
    for folder in (package, room):
        (folder / "__init__.py").touch()
    (room / "plain.py").write_text("x = 1\n")
    assert compiled._package_root(room / "callee.py") == package
    folders = []
    for file, text in (
        ("callee.py", "@compiled\ndef callee(x):\n    return x + 1\n"),
        ("callee.py", "@compiled\ndef callee(x):\n    return x + 2\n"),
        ("constants.py", "# Read by compiled code.\nx = 1\n"),
        ("inlined.py", "@inlined\ndef f(x):\n    return x\n"),
        ("plain.py", "x = 2\n"),
    ):
        (room / file).write_text(text)
        compiled._cache_directory.cache_clear()
        folders.append(compiled._cache_directory(package))
    # Files that compiled code does not read have no effect.
    assert len(set(folders)) == 4
    assert folders[-1] == folders[-2]


@compiled.compiled
def _weighted(weight: float, one: float, other: float) -> float:
    return one + weight * (other - one)


def test_products_and_sums_are_rounded_as_in_python() -> None:
    draw = random.Random(4).gauss
    for _ in range(1000):
        numbers = draw(0.0, 1.0), draw(0.0, 1.0), draw(0.0, 1.0)
        assert _weighted(*numbers) == _weighted.__wrapped__(*numbers)  # type: ignore[attr-defined]
