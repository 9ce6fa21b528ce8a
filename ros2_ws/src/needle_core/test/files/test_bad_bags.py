"""Damaged and unsupported bags: rejected in one line."""

from __future__ import annotations

import fcntl
import shutil
import struct
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin

from needle_core.errors import UserError
from needle_core.files.bag_path import BrokenBagError, require_bag

from .made_bags import (
    ALL,
    change,
    payload,
    plain,
    read,
    reason,
    refusal,
    rosbag,
    write_mcap,
)


@pytest.mark.parametrize("text", ["just text", "\x00", ""])
def test_malformed_metadata_are_rejected(bag: Path, text: str) -> None:
    (bag / "metadata.yaml").write_text(text)
    assert "metadata.yaml" in reason(bag)


def test_links_and_files_outside_of_the_bag_are_not_opened(bag: Path, tmp_path: Path) -> None:
    (file,) = bag.glob("*.mcap")
    elsewhere = file.rename(tmp_path / file.name)
    file.symlink_to(elsewhere)
    assert f"{file.name}: it is a link" in reason(bag)
    file.unlink()
    for outside in (f"../{file.name}", str(elsewhere)):
        change(bag, relative_file_paths=[outside])
        assert "No such file" in reason(bag)


def test_a_message_of_another_type_is_refused(bag: Path) -> None:
    file = plain(bag, use_chunking=False)
    first = struct.pack("<QQ", 1000, 1)
    file.write_bytes(file.read_bytes().replace(first + payload(0), first + b"\x07" * 8))
    assert "a message of /a does not match its definition" in reason(bag)
    write_mcap(file, encoding="json")
    with pytest.raises(UserError, match="/a is not in CDR, the only supported encoding"):
        read(file)


# ---- not a bag, or an unsupported storage --------------------------------------------------------


def test_an_incomplete_bag_is_reported_with_its_remedy(bag: Path, tmp_path: Path) -> None:
    (tmp_path / "README.md").touch()
    for path, words in (
        (bag / "metadata.yaml", f"name an .mcap file or the bag's directory, {bag}"),
        (tmp_path / "README.md", "README.md is a file: name an .mcap file or the bag's directory"),
        (tmp_path / "none", "no such bag directory"),
        (tmp_path, "is not a bag: it has no metadata.yaml"),
    ):
        with pytest.raises(UserError) as caught:
            require_bag(path)
        assert str(caught.value).endswith(words)
    (bag / "metadata.yaml").unlink()
    with pytest.raises(BrokenBagError, match=r"was not completed .*: run .*needle_bags recover"):
        require_bag(bag)
    (file,) = bag.iterdir()
    with file.open("rb") as recorder:
        fcntl.flock(recorder, fcntl.LOCK_EX)
        with pytest.raises(UserError, match="the bag is still being recorded"):
            require_bag(bag)
    for stem in ("one", "two"):
        shutil.copy(file, bag / f"{stem}.mcap")
    file.unlink()
    with pytest.raises(UserError, match=r"two recordings in one folder \(one.mcap, two.mcap\)"):
        require_bag(bag)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"compression_mode": "FILE", "compression_format": "lz4"}, "compression 'lz4'"),
        ({"storage_identifier": "my_storage"}, "storage 'my_storage'"),
        ({"version": 10, "relative_file_paths": None}, "metadata.yaml has version 10"),
    ],
)
def test_an_unsupported_storage_is_not_reported_as_broken(
    bag: Path, values: dict[str, object], words: str
) -> None:
    change(bag, version=10, something_new={"a": 1})
    assert read(bag) == ALL
    change(bag, **{"version": 9, **values})
    text = refusal(bag)
    assert words in text
    assert "recover" not in text


def test_a_truncated_sqlite_bag_is_refused_with_another_remedy(tmp_path: Path) -> None:
    bag = rosbag(tmp_path / "bag", StoragePlugin.SQLITE3)
    (file,) = bag.glob("*.db3")
    file.write_bytes(file.read_bytes()[:5000])
    assert refusal(bag).endswith(
        f"`recover` repairs MCAP only; SQLite needs `ros2 bag reindex {bag}`"
    )
