"""Bags, damaged or made to harm: refused in one line."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import sqlite3
import struct
from io import BytesIO
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from needle_core.errors import UserError
from needle_core.files.bag_path import BrokenBagError, require_bag

from .made_bags import (
    ALL,
    COUNT,
    MEGABYTE,
    begin,
    change,
    payload,
    plain,
    read,
    reason,
    refusal,
    rosbag,
    write_mcap,
)

HARMFUL = [
    "a: &a [x, x]\n" + "".join(f"b{n}: &b{n} [*a, *a]\n" for n in range(40)),
    "[" * 100_000,
    "x: " + "y" * 17 * MEGABYTE,
    "just text",
    "\x00",
]


@pytest.mark.parametrize("text", HARMFUL, ids=["aliases", "deep", "large", "text", "zero"])
def test_metadata_made_to_harm_are_refused(bag: Path, text: str) -> None:
    (bag / "metadata.yaml").write_text(text)
    said = reason(bag)
    assert "metadata.yaml" in said
    assert ("larger than" in said) is (len(text) > 2**24)


def test_no_pipe_or_link_is_opened_and_no_file_outside_of_the_bag(
    bag: Path, tmp_path: Path
) -> None:
    for file in sorted(bag.iterdir(), reverse=True):
        elsewhere = file.rename(tmp_path / file.name)
        os.mkfifo(file)
        assert f"{file.name}: it is not a regular file" in reason(bag)
        file.unlink()
        file.symlink_to(elsewhere)
        assert f"{file.name}: it is a link" in reason(bag)
        elsewhere.replace(file)
    (file,) = bag.glob("*.mcap")
    elsewhere = file.rename(tmp_path / file.name)
    for outside in (f"../{file.name}", str(elsewhere)):
        change(bag, relative_file_paths=[outside])
        assert "No such file" in reason(bag)


@pytest.mark.parametrize(
    ("compression", "told"), [("zstd", None), ("zstd", 1000), ("lz4", 1000), ("br1", 1000)]
)
def test_a_chunk_that_would_fill_the_memory_or_cannot_be_read_is_refused(
    bag: Path, compression: str, told: int | None
) -> None:
    size = 600 * MEGABYTE
    block = bytes(size // 100)
    if compression == "lz4":
        packer = lz4.frame.LZ4FrameCompressor()
        bomb = packer.begin() + b"".join(packer.compress(block) for _ in range(100))
        bomb += packer.flush()
    else:
        bomb = b"".join([zstandard.ZstdCompressor().compress(block)] * 100)
    (file,) = bag.glob("*.mcap")
    file.write_bytes(one_chunk(bomb, compression, told or size))
    # What is kept in another way need not be broken.
    assert ("recover" in reason(bag)) is (compression != "br1")
    assert ("'br1' is not read here" in reason(bag)) is (compression == "br1")


def one_chunk(stored: bytes, compression: str, size: int) -> bytes:
    """Return a file of one chunk, by the library's own records."""
    stream = BytesIO()
    mcap = begin(stream, chunk_size=MEGABYTE)
    for number in range(COUNT):
        mcap.add_message(1 + number % 2, 1000, payload(number), 1, number)
    mcap.flush()  # type: ignore[no-untyped-call]
    builder = RecordBuilder()
    Chunk(compression, stored, 1000, 1000, 0, size).write(builder)
    (index,) = mcap._Writer__chunk_indices  # type: ignore[attr-defined]
    index.chunk_length, index.compression = builder.count, compression
    index.compressed_size, index.uncompressed_size = len(stored), size
    stream.seek(8 + struct.unpack_from("<Q", stream.getvalue(), 9)[0] + 9)
    stream.truncate()
    stream.write(builder.end())  # type: ignore[no-untyped-call]
    mcap.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def test_a_message_of_another_time_or_type_is_refused(bag: Path) -> None:
    for chunked in (True, False):
        plain(bag, times=lambda number: 2**63 + number, use_chunking=chunked)
        assert "2262" in reason(bag)
    file = plain(bag, use_chunking=False)
    first = struct.pack("<QQ", 1000, 1)
    file.write_bytes(file.read_bytes().replace(first + payload(0), first + b"\x07" * 8))
    assert "a message of /a does not fit its definition" in reason(bag)
    write_mcap(file, encoding="json")
    with pytest.raises(UserError, match="/a is not in CDR, which alone is read here"):
        read(file)


# ---- what is no bag, or kept in another way -----------------------------------------------------


def test_what_is_no_whole_bag_is_named_with_the_remedy(bag: Path, tmp_path: Path) -> None:
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
        ({"compression_mode": "MESSAGE", "compression_format": "br"}, "compression 'br'"),
        ({"storage_identifier": "my_storage"}, "storage 'my_storage'"),
        ({"version": 10, "relative_file_paths": None}, "metadata.yaml is of version 10"),
        ({"version": 10, "topics_with_message_count": [{"topic": "/a"}]}, "of version 10"),
        ({"version": 10, "message_count": None, "topics_with_message_count": 3}, "version 10"),
    ],
)
def test_what_is_kept_in_another_way_is_not_broken(
    bag: Path, values: dict[str, object], words: str
) -> None:
    change(bag, version=10, something_new={"a": 1})
    assert read(bag) == ALL
    change(bag, **{"version": 9, **values})
    said = refusal(bag)
    assert words in said
    assert "recover" not in said


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_truncated_sqlite_bag_has_one_remedy(tmp_path: Path, share: float) -> None:
    bag = rosbag(tmp_path / "bag", StoragePlugin.SQLITE3)
    (file,) = bag.glob("*.db3")
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * share)])
    remedy = f"mends MCAP only: `sqlite3 {file} .recover` may still read a part"
    write_mcap(bag / "stranger.mcap")
    assert refusal(bag).endswith(remedy)
    for other in ("metadata.yaml", "stranger.mcap"):
        (bag / other).unlink()
    assert refusal(bag).endswith(remedy)
    file.write_bytes(data)
    assert refusal(bag).endswith(f"run `ros2 bag reindex {bag}`")
    packed = rosbag(tmp_path / "packed", StoragePlugin.SQLITE3, CompressionMode.FILE)
    (file,) = packed.glob("*.zstd")
    file.write_bytes(file.read_bytes()[:-100])
    assert reason(packed).endswith("`recover` mends MCAP only")


@pytest.mark.parametrize("mode", ["WAL", "DELETE"])
def test_a_journal_beside_a_sqlite_bag_is_to_be_taken_in(tmp_path: Path, mode: str) -> None:
    """What the command of the message does makes the bag whole."""
    bag, killed = rosbag(tmp_path / "bag", StoragePlugin.SQLITE3), tmp_path / "killed" / "bag"
    (file,) = bag.glob("*.db3")
    with contextlib.closing(sqlite3.connect(file, isolation_level=None)) as database:
        database.execute(f"PRAGMA journal_mode={mode}")
        database.execute("PRAGMA cache_size=1")
        database.execute("BEGIN")
        database.execute("DELETE FROM messages WHERE id > 50")
        # More than its cache holds: what was deleted is gone from the file, too.
        database.execute("CREATE TABLE filler AS SELECT zeroblob(1000000)")
        if mode == "WAL":
            database.execute("COMMIT")
        shutil.copytree(bag, killed)
    if mode == "WAL":
        # All that metadata.yaml tells of is in the file: the bag is as it was.
        assert read(killed) == ALL
        (killed / "metadata.yaml").unlink()
    journal = killed / f"{file.name}-{'wal' if mode == 'WAL' else 'journal'}"
    said = refusal(killed)
    assert f"SQLite has not taken in {journal.name} yet: run `sqlite3 " in said
    program, name, statement = said.partition("run `")[2].rstrip("`").split(" ", 2)
    assert (program, Path(name)) == ("sqlite3", killed / file.name)
    with contextlib.closing(sqlite3.connect(name)) as mended:
        mended.execute(statement.strip("'"))
    assert not journal.exists()
    if mode == "DELETE":
        assert read(killed) == ALL
    else:
        assert "ros2 bag reindex" in refusal(killed)
