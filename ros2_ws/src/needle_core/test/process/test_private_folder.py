"""A folder is private, or it is not used."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from needle_core.process.private_folder import private_folder


@pytest.fixture
def place(tmp_path: Path) -> Path:
    tmp_path.chmod(0o755)
    return tmp_path


@pytest.mark.parametrize("mask", [0o000, 0o022, 0o077])
def test_it_is_made_for_its_owner_alone_whatever_the_umask(place: Path, mask: int) -> None:
    before = os.umask(mask)
    try:
        folder = private_folder(place / "cache", "outer", "inner")
    finally:
        os.umask(before)
    assert folder == place / "cache" / "outer" / "inner"
    for made in (folder, folder.parent, place / "cache"):
        assert stat.S_IMODE(made.stat().st_mode) == 0o700


def test_it_is_found_again(place: Path) -> None:
    folder = private_folder(place, "outer", "inner")
    assert folder is not None
    (folder / "kept").touch()
    assert private_folder(place, "outer", "inner") == folder
    assert (folder / "kept").exists()


@pytest.mark.parametrize("which", ["outer", "outer/inner"])
@pytest.mark.parametrize("mode", [0o777, 0o770, 0o720, 0o702, 0o755, 0o1777])
def test_one_that_is_open_to_others_is_not_used(place: Path, which: str, mode: int) -> None:
    (place / "outer" / "inner").mkdir(parents=True)
    for name in ("outer", "outer/inner"):
        (place / name).chmod(mode if name == which else 0o700)
    assert private_folder(place, "outer", "inner") is None


@pytest.mark.parametrize("which", ["outer", "outer/inner"])
def test_a_link_is_not_followed(place: Path, which: str) -> None:
    elsewhere = private_folder(place, "elsewhere", "inner")
    assert elsewhere is not None
    if which == "outer":
        (place / "outer").symlink_to(place / "elsewhere")
    else:
        (place / "outer").mkdir(mode=0o700)
        (place / "outer" / "inner").symlink_to(elsewhere)
    assert private_folder(place, "outer", "inner") is None


@pytest.mark.parametrize("which", ["outer", "outer/inner"])
def test_a_file_in_its_place_is_none(place: Path, which: str) -> None:
    if which != "outer":
        (place / "outer").mkdir(mode=0o700)
    (place / which).touch(mode=0o700)
    assert private_folder(place, "outer", "inner") is None


def test_another_users_is_not_used(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert private_folder(place, "outer", "inner") is not None
    # The place may be the system's, what lies in it must be ours.
    place.chmod(0o1777)
    other = os.getuid() + 1
    monkeypatch.setattr(os, "getuid", lambda: other)
    assert private_folder(place, "outer", "inner") is None


@pytest.mark.parametrize(("mode", "used"), [(0o777, False), (0o775, False), (0o1777, True)])
def test_a_place_where_others_could_exchange_it(place: Path, mode: int, used: bool) -> None:
    place.chmod(mode)
    assert (private_folder(place, "outer") is not None) is used


def test_where_none_can_be_made_there_is_none(place: Path) -> None:
    (place / "file").touch()
    assert private_folder(place / "file", "outer") is None
