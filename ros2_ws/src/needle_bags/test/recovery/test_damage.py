"""Files cut and damaged anywhere: a bag is what came before, and what follows is told."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.opcode import Opcode
from mcap.reader import make_reader

from needle_bags.recovery.bag_recovery import recover_bag
from needle_bags.recovery.mcap_prefix import last_time
from needle_core.errors import UserError
from needle_core.files.bag_directory import BagDirectory

from .numbered_bag import (
    START,
    STEP,
    contents,
    damage,
    numbers,
    payload,
    write,
    write_unchunked,
)

COUNT = 150
SPLIT = 240
HARMS = ("bit", "zeros", "noise", "cut", "cut to zeros")
KINDS = ("chunked", "zstd", "unchunked", "split", "unfinished")


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One bag of each kind."""
    folder = tmp_path_factory.mktemp("bags")
    write(folder / "chunked", COUNT)
    write(folder / "zstd", COUNT, compression="zstd")
    write_unchunked(folder / "unchunked", COUNT)
    write(folder / "split", COUNT, max_file_size=7500)
    unfinished = write(folder / "unfinished", COUNT)
    (unfinished / "metadata.yaml").unlink()
    file = unfinished / "unfinished_0.mcap"
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    last = summary.chunk_indexes[-1]
    end = last.chunk_start_offset + last.chunk_length + last.message_index_length
    file.write_bytes(file.read_bytes()[:end])
    return folder


def whole_before(bag: Path, kind: str, name: str, offset: int) -> int:
    """How many messages are in whole chunks, or records, before an offset of a file."""
    count = 0
    for file in sorted(bag.glob("*.mcap")):
        limit = offset if file.name == name else 2**62 if file.name < name else 0
        data = file.read_bytes()
        if kind == "unchunked":
            return sum(data.find(payload(n)) + len(payload(n)) <= limit for n in range(COUNT))
        position = 8
        while position + 9 < min(limit, len(data)):
            opcode, length = struct.unpack_from("<BQ", data, position)
            position += 9 + length
            if opcode == Opcode.DATA_END:
                break
            if opcode == Opcode.MESSAGE_INDEX and position <= limit:
                count += struct.unpack_from("<I", data, position - length + 2)[0] // 16
    return count


def hurt(data: bytes, kind: str, start: int, end: int, rng: np.random.Generator) -> bytes:
    """Return data with a wrong bit, zeros, noise, without an end, or with zeros for its end."""
    if kind == "bit":
        return data[:start] + bytes([data[start] ^ 1 << int(rng.integers(8))]) + data[start + 1 :]
    if kind == "cut":
        return data[:start]
    if kind == "cut to zeros":
        return data[:start] + bytes(len(data) - start)
    middle = bytes(end - start) if kind == "zeros" else rng.bytes(end - start)
    return data[:start] + middle + data[end:]


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_bag_is_all_before_the_damage(
    tmp_path: Path, bags: Path, kind: str, seed: int
) -> None:
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    for harm in HARMS:
        bag = tmp_path / harm / kind
        shutil.copytree(bags / kind, bag)
        file = rng.choice(sorted(bag.glob("*.mcap")))
        data = file.read_bytes()
        start = int(rng.integers(len(data)))
        end = min(len(data), start + int(rng.integers(1, 3000)))
        least = whole_before(bag, kind, file.name, start)
        file.write_bytes(hurt(data, harm, start, end, rng))
        before = contents(bag)
        what = f"{harm}: {start} to {end} of {len(data)} bytes of {file.name}"
        try:
            recovery = recover_bag(bag)
        except UserError as error:
            assert least == 0, f"{what}: {error}"
            assert contents(bag) == before
            continue
        with BagDirectory(bag) as directory:
            kept = [message.data for message in directory.messages(lambda _: True)]
        # Without a checksum nothing tells a wrong byte within a message.
        unchecked = kind == "unchunked" and harm != "cut"
        right = [number for number, found in enumerate(kept) if found == payload(number)]
        assert len(right) == len(kept) or (unchecked and len(kept) - len(right) < 30), what
        assert len(kept) >= least - (kind == "unchunked"), what
        assert recovery.messages == len(kept)
        assert recovery.lost or len(kept) == COUNT, what
        assert set(before.values()) <= set(contents(bag).values()), what
        assert not [path for path in bag.iterdir() if path.name.startswith(".")]
        assert recover_bag(bag).was_whole


@pytest.mark.parametrize("told", ["metadata", "index", "chunks", "nothing"])
def test_the_time_that_follows_is_told_as_well_as_it_is_known(tmp_path: Path, told: str) -> None:
    bag = write_unchunked(tmp_path / "bag") if told == "nothing" else write(tmp_path / "bag")
    file = bag / "bag_0.mcap"
    if told == "nothing":
        data = bytearray(file.read_bytes())
        data[data.index(payload(150)) - 30] ^= 64  # the length of a message
        file.write_bytes(data)
    else:
        damage(file)
    if told != "metadata":
        (bag / "metadata.yaml").unlink()
    if told in ("chunks", "nothing"):
        file.write_bytes(file.read_bytes()[:-8])
    recovery = recover_bag(bag)
    kept = len(numbers(bag))
    assert 120 <= kept <= 160
    if told == "nothing":
        assert recovery.seconds_lost is None
        assert recovery.lost.endswith("on: how much time follows cannot be told")
    else:
        assert recovery.seconds_lost == pytest.approx((300 - kept) * STEP / 1e9)
        least = "at least " if told == "chunks" else ""
        assert recovery.lost.endswith(f"on: {least}{recovery.seconds_lost:.1f} s follow")


def test_where_a_recorder_was_killed_between_chunks_half_a_second_is_gone(
    tmp_path: Path, bags: Path
) -> None:
    bag = tmp_path / "unfinished"
    shutil.copytree(bags / "unfinished", bag)
    recovery = recover_bag(bag)
    assert numbers(bag) == list(range(COUNT))
    assert recovery.seconds_lost is None
    assert "(the file ends there) on: half a second at most if a kill ended it" in recovery.lost


def seconds_behind(kept: int) -> float:
    return (SPLIT - kept) * STEP / 1e9


@pytest.fixture
def split(tmp_path: Path) -> Path:
    """A bag of three files."""
    bag = write(tmp_path / "bag", SPLIT, max_file_size=11_000)
    assert len(list(bag.glob("*.mcap"))) == 3
    return bag


def test_a_bag_of_several_files_ends_at_the_damage(split: Path) -> None:
    before = contents(split)
    first = damage(split / "bag_1.mcap")
    recovery = recover_bag(split)
    kept = numbers(split)
    assert kept == list(range(len(kept)))
    assert len(kept) <= first < len(kept) + 60
    assert recovery.seconds_lost == pytest.approx(seconds_behind(len(kept)))
    assert recovery.left_out == ["bag_2.mcap: behind the damage"]
    assert recovery.kept == ["metadata.yaml.damaged", "bag_1.mcap.damaged"]
    after = contents(split)
    assert all(after[name] == before[name] for name in ("bag_0.mcap", "bag_2.mcap"))
    (again,) = {line.partition(" (it begins ")[0][10:] for line in recover_bag(split).left_out}
    assert again == ": not of this bag"


@pytest.mark.parametrize("has_metadata", [True, False])
def test_a_bag_ends_before_a_missing_file(split: Path, has_metadata: bool) -> None:
    (split / "bag_1.mcap").unlink()
    if not has_metadata:
        (split / "metadata.yaml").unlink()
    recovery = recover_bag(split)
    kept = numbers(split)
    assert kept == list(range(len(kept)))
    assert 60 < len(kept) < 120
    follow = f"{seconds_behind(len(kept)):.1f} s follow"
    assert recovery.lost == f"all from bag_1.mcap (it is missing) on: {follow}"
    assert recovery.left_out == ["bag_2.mcap: behind the damage"]


def test_the_time_of_a_missing_last_file_is_not_known_without_metadata(split: Path) -> None:
    (split / "bag_2.mcap").unlink()
    document = yaml.safe_load((split / "metadata.yaml").read_text())
    del document["rosbag2_bagfile_information"]["duration"]
    (split / "metadata.yaml").write_text(yaml.safe_dump(document))
    recovery = recover_bag(split)
    assert recovery.seconds_lost is None
    assert "bag_2.mcap (it is missing)" in recovery.lost


def test_a_damaged_index_costs_nothing_and_no_file_behind_it(split: Path) -> None:
    for name in ("bag_0.mcap", "bag_2.mcap"):
        data = bytearray((split / name).read_bytes())
        data[-60] ^= 1
        (split / name).write_bytes(data)
    recovery = recover_bag(split)
    assert (recovery.lost, recovery.seconds_lost, recovery.left_out) == ("", 0.0, [])
    assert numbers(split) == list(range(SPLIT))


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_a_chunk_whose_type_or_header_is_wrong_is_damage(tmp_path: Path, compression: str) -> None:
    """Readers pass over a record of a type that they do not know, and over an empty chunk."""
    bag = write(tmp_path / "bag", compression=compression)
    file = bag / "bag_0.mcap"
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[3]
    whole, start = file.read_bytes(), chunk.chunk_start_offset
    types = [bytes([whole[start] ^ 1 << bit]) + whole[start + 1 : start + 57] for bit in (0, 3, 7)]
    for head in (*types, whole[start : start + 9] + bytes(48)):
        file.write_bytes(whole[:start] + head + whole[start + 57 :])
        recover_bag(bag)
        assert numbers(bag) == list(range((chunk.message_start_time - START) // STEP))


@pytest.mark.parametrize("bit", [0, 6, 8, 63])
def test_a_message_whose_length_is_wrong_is_damage(tmp_path: Path, bit: int) -> None:
    """Without chunks all that tells where a message ends is the length before it."""
    bag = write_unchunked(tmp_path / "bag", 60)
    file = bag / "bag_0.mcap"
    data = bytearray(file.read_bytes())
    place = data.index(payload(40)) - 30
    data[place + bit // 8] ^= 1 << bit % 8
    file.write_bytes(data)
    with pytest.raises(UserError, match="recover"), BagDirectory(bag) as directory:
        list(directory.messages(lambda _: True))
    recover_bag(bag)
    assert numbers(bag) == list(range(40))


def test_the_time_of_a_message_that_the_index_contradicts_is_damage(tmp_path: Path) -> None:
    bag = write_unchunked(tmp_path / "bag", 60)
    file = bag / "bag_0.mcap"
    data = bytearray(file.read_bytes())
    data[data.index(payload(40)) - 9] ^= 1
    file.write_bytes(data)
    assert "a message is not of the recording's time" in recover_bag(bag).lost
    assert numbers(bag) == list(range(40))


def test_zeros_in_images_are_no_chunks(tmp_path: Path) -> None:
    file = tmp_path / "noise"
    file.write_bytes(b"\x06" + bytes(200) + b"\x06" * 9 + bytes(300))
    assert last_time(file, 0) == (0, False)
    assert last_time(file, 10_000) == (0, False)
