"""Files cut and damaged anywhere: a bag is what came before, and what follows is told."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.opcode import Opcode

from needle_bags.recovery.bag_recovery import recover_bag
from needle_bags.recovery.mcap_prefix import last_time
from needle_core.errors import UserError
from needle_core.files.bag_directory import BagDirectory

from .numbered_bag import (
    START,
    STEP,
    chunks,
    contents,
    damage,
    flip,
    numbers,
    payload,
    write,
    write_unchunked,
)

COUNT, SPLIT = 150, 240
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
    last = chunks(file)[-1]
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
        position = opcode = 8
        while opcode != Opcode.DATA_END and position + 9 < min(limit, len(data)):
            opcode, length = struct.unpack_from("<BQ", data, position)
            position += 9 + length
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
        flip(file, file.read_bytes().index(payload(150)) - 30, 64)  # the length of a message
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


@pytest.fixture
def split(tmp_path: Path) -> Path:
    """A bag of three files."""
    bag = write(tmp_path / "bag", SPLIT, max_file_size=11_000)
    assert len(list(bag.glob("*.mcap"))) == 3
    return bag


@pytest.mark.parametrize("harm", ["damaged", "missing", "missing, and no metadata"])
def test_a_bag_of_several_files_ends_at_the_first_that_is_not_whole(split: Path, harm: str) -> None:
    first = damage(split / "bag_1.mcap") if harm == "damaged" else 90
    if harm != "damaged":
        (split / "bag_1.mcap").unlink()
    if "metadata" in harm:
        (split / "metadata.yaml").unlink()
    before = contents(split)
    recovery = recover_bag(split)
    kept = numbers(split)
    assert kept == list(range(len(kept)))
    assert len(kept) - 30 < first < len(kept) + 60
    assert recovery.seconds_lost == pytest.approx((SPLIT - len(kept)) * STEP / 1e9)
    assert recovery.left_out == ["bag_2.mcap: behind the damage"]
    after = contents(split)
    assert all(after[name] == before[name] for name in ("bag_0.mcap", "bag_2.mcap"))
    if harm == "damaged":
        assert recovery.kept == ["metadata.yaml.damaged", "bag_1.mcap.damaged"]
        (left_out,) = recover_bag(split).left_out
        assert left_out.startswith("bag_2.mcap: not of this bag (it begins ")
    else:
        follow = f"on: {recovery.seconds_lost:.1f} s follow"
        assert recovery.lost == f"all from bag_1.mcap (it is missing) {follow}"


def test_of_a_split_bag_the_last_file_can_be_missing_and_an_index_be_damaged(split: Path) -> None:
    flip(split / "bag_0.mcap", -60)
    flip(split / "bag_2.mcap", -60)
    recovery = recover_bag(split)
    assert (recovery.lost, recovery.seconds_lost, recovery.left_out) == ("", 0.0, [])
    assert numbers(split) == list(range(SPLIT))
    (split / "bag_2.mcap").unlink()
    document = yaml.safe_load((split / "metadata.yaml").read_text())
    del document["rosbag2_bagfile_information"]["duration"]
    (split / "metadata.yaml").write_text(yaml.safe_dump(document))
    recovery = recover_bag(split)
    assert recovery.seconds_lost is None
    assert "bag_2.mcap (it is missing)" in recovery.lost


def test_a_chunk_whose_type_or_header_is_wrong_is_damage(tmp_path: Path) -> None:
    """Readers pass over a record of a type that they do not know, and over an empty chunk."""
    for compression in ("none", "zstd"):
        bag = write(tmp_path / compression, 120, compression=compression)
        file = bag / f"{compression}_0.mcap"
        chunk = chunks(file)[3]
        whole, start = file.read_bytes(), chunk.chunk_start_offset
        types = [bytes([whole[start] ^ bit]) + whole[start + 1 : start + 57] for bit in (1, 128)]
        for head in (*types, whole[start : start + 9] + bytes(48)):
            file.write_bytes(whole[:start] + head + whole[start + 57 :])
            recover_bag(bag)
            assert numbers(bag) == list(range((chunk.message_start_time - START) // STEP))


def test_a_message_of_wrong_length_or_time_is_damage(tmp_path: Path) -> None:
    """Without chunks all that tells where a message ends is the length before it."""
    whole = write_unchunked(tmp_path / "whole", 60) / "whole_0.mcap"
    begin = whole.read_bytes().index(payload(40)) - 30
    for place, bits in ((begin, 1), (begin, 64), (begin + 1, 1), (begin + 7, 128)):
        bag = tmp_path / f"{place}_{bits}"
        shutil.copytree(whole.parent, bag)
        flip(bag / whole.name, place, bits)
        with pytest.raises(UserError, match="recover"), BagDirectory(bag) as directory:
            list(directory.messages(lambda _: True))
        recover_bag(bag)
        assert numbers(bag) == list(range(40))
    flip(whole, begin + 21)
    assert "a message is not of the recording's time" in recover_bag(whole.parent).lost
    assert numbers(whole.parent) == list(range(40))


def test_zeros_in_images_are_no_chunks(tmp_path: Path) -> None:
    file = tmp_path / "noise"
    file.write_bytes(b"\x06" + bytes(200) + b"\x06" * 9 + bytes(300))
    assert last_time(file, 0) == last_time(file, 10_000) == (0, False)
