from __future__ import annotations

import os
from pathlib import Path

import pytest

from needle_core.files.file_access import open_regular, replace_file


def test_a_link_is_replaced_and_what_it_names_is_not_touched(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("mine")
    link = tmp_path / "link"
    link.symlink_to(precious)
    replace_file(link, b"new")
    assert precious.read_text() == "mine"
    assert not link.is_symlink()
    assert link.read_bytes() == b"new"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "precious"]


def test_the_mode_is_that_of_any_new_file(tmp_path: Path) -> None:
    replace_file(tmp_path / "one", b"")
    (tmp_path / "other").touch()
    assert (tmp_path / "one").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_what_cannot_be_written_leaves_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="directory"):
        replace_file(tmp_path / "folder", b"new")
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "file").write_text("text")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    for name, reason in (("pipe", "not a regular file"), ("link", "link"), ("none", "No such")):
        with pytest.raises(OSError, match=reason):
            open_regular(tmp_path / name)
    with pytest.raises(OSError, match="not a regular file"):
        open_regular(tmp_path)
    with open_regular(tmp_path / "file") as stream:
        assert stream.read() == b"text"
