"""Regular files only, and atomic replacement of files."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from needle_core.files.file_access import open_regular, replace_file


def test_a_file_is_replaced_whole_and_a_links_target_is_not_touched(tmp_path: Path) -> None:
    precious, link = tmp_path / "precious", tmp_path / "link"
    precious.write_text("mine")
    link.symlink_to(precious)
    replace_file(link, b"new")
    assert precious.read_text() == "mine"
    assert not link.is_symlink()
    assert link.read_bytes() == b"new"
    # Like any new file.
    assert link.stat().st_mode == precious.stat().st_mode
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="directory"):
        replace_file(tmp_path / "folder", b"new")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "link", "precious"]


def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "file").write_text("text")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    for name, reason in (
        ("pipe", "not a regular"),
        ("link", "link"),
        ("none", "No such"),
        ("", "not a r"),
    ):
        with pytest.raises(OSError, match=reason):
            open_regular(tmp_path / name)
    with open_regular(tmp_path / "file") as stream:
        assert stream.read() == b"text"
