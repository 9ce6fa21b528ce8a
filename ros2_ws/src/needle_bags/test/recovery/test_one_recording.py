"""Folders with files of several recordings: which of them are a bag's."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from needle_bags.reading.bag_files import read_contents
from needle_bags.recovery import recover
from needle_bags.recovery.bag_recovery import recover_bag
from needle_core.errors import UserError
from needle_core.files.bag_path import recording_files

from .numbered_bag import RUN, contents, damage, kill, numbers, write

OTHER = {"commit": "7654def", "run_info": "seed: 4"}


def put(folder: Path, *bags: tuple[Path, str]) -> Path:
    """Copy the first file of bags into a folder, under other names."""
    folder.mkdir(exist_ok=True)
    for bag, name in bags:
        shutil.copyfile(min(bag.glob("*.mcap")), folder / name)
    return folder


@pytest.fixture
def stranger(tmp_path: Path) -> Path:
    """A recording of another run, days later."""
    return write(tmp_path / "stranger", 90, first=30_000_000, run=OTHER)


def test_two_recordings_in_one_folder_are_not_merged_but_each_is_read_alone(
    tmp_path: Path, stranger: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write(tmp_path / "bag", 90)
    folder = put(tmp_path / "dl", (bag, "mon.day.mcap"), (stranger, "tuesday.mcap"))
    before = contents(folder)
    assert recover.main([str(folder)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "two recordings in one folder (mon.day.mcap, tuesday.mcap)" in said
    assert "give each a folder of its own, or name one of the files" in said
    alone, whole = read_contents(folder / "tuesday.mcap"), read_contents(stranger)
    assert (alone.topics, alone.counts) == (whole.topics, +whole.counts)
    assert whole.custom_data.items() <= alone.custom_data.items()
    assert (alone.start, alone.end, alone.distribution) == (whole.start, whole.end, "jazzy")
    assert contents(folder) == before


@pytest.mark.parametrize("harm", ["nothing", "metadata", "data"])
def test_a_stranger_beside_a_bag_is_named_and_left(
    tmp_path: Path, stranger: Path, capsys: pytest.CaptureFixture[str], harm: str
) -> None:
    """Without metadata.yaml, the bag is the files that are called as its folder."""
    path = write(tmp_path / "bag", max_file_size=20_000)
    put(path, (stranger, "a_stranger.mcap"))
    (path / "notes.mcap").write_bytes(b"no MCAP file")
    (path / "._bag_0.mcap").write_bytes(b"another system's notes of bag_0.mcap")
    data = (path / "a_stranger.mcap").read_bytes()
    if harm == "metadata":
        (path / "metadata.yaml").unlink()
    elif harm == "data":
        damage(path / "bag_1.mcap", share=0.4)
    assert recover.main([str(path)]) == 0
    said = capsys.readouterr().out
    assert "left out: a_stranger.mcap: not of this bag (it begins " in said
    assert "days after the bag, another commit, another run_info)" in said
    assert "left out: notes.mcap: not of this bag (not whole)" in said
    assert said.count("left out") == 2
    assert (path / "a_stranger.mcap").read_bytes() == data
    kept = numbers(path)
    assert kept == list(range(len(kept)))
    assert len(kept) == 300 or (harm == "data" and len(kept) > 200)
    assert recover_bag(path).was_whole


@pytest.mark.parametrize("beside_a_bag", [False, True])
def test_a_killed_file_among_others_is_made_whole_alone(
    tmp_path: Path, stranger: Path, beside_a_bag: bool
) -> None:
    """What metadata.yaml tells is of other files."""
    killed = kill(write(tmp_path / "killed"))
    folder = stranger if beside_a_bag else put(tmp_path / "dl", (stranger, "b.mcap"))
    put(folder, (killed, "a.mcap"))
    before = contents(folder)
    with pytest.raises(UserError, match=rf"recover {folder / 'a.mcap'}`$"):
        read_contents(folder / "a.mcap")
    recovery = recover_bag(folder / "a.mcap")
    assert numbers(folder / "a.mcap") == list(range(recovery.messages))
    assert recovery.lost.endswith("(the file ends within a record) on: at least 0.3 s follow")
    told = read_contents(folder / "a.mcap").custom_data
    assert (told["recovered"], told["commit"]) == (recovery.lost, RUN["commit"])
    after = contents(folder)
    assert after.pop("a.mcap.damaged") == before.pop("a.mcap")
    assert after.pop("a.mcap")
    assert after == before
    assert recover_bag(folder / "a.mcap").was_whole


def test_a_file_of_a_bag_is_recovered_with_its_bag(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", max_file_size=20_000)
    damage(path / "bag_1.mcap")
    recover_bag(path / "bag_1.mcap")
    assert recover_bag(path).was_whole
    assert 0 < len(numbers(path)) < 300


@pytest.mark.parametrize(
    ("first", "run", "is_killed", "words"),
    [
        (400, RUN, False, "x_1.mcap is the beginning of a recording"),
        (100, {}, True, "x_1.mcap begins 2.0 s before x_0.mcap ends"),
        (10_000, {}, False, "x_1.mcap begins 97.0 s after x_0.mcap ends"),
        (30_000_000, {}, True, "x_1.mcap begins 3.5 days after x_0.mcap ends"),
    ],
)
def test_one_stem_of_two_recordings_is_not_merged(
    tmp_path: Path, first: int, run: dict[str, str], is_killed: bool, words: str
) -> None:
    one, two = write(tmp_path / "one"), write(tmp_path / "two", first=first, run=run)
    if is_killed:
        kill(two)
    folder = put(tmp_path / "dl", (one, "x_0.mcap"), (two, "x_1.mcap"))
    before = contents(folder)
    with pytest.raises(UserError, match=f"two recordings in one folder: {words}"):
        recover_bag(folder)
    assert contents(folder) == before


def test_another_run_is_told_by_what_ends_its_file_or_begins_it(tmp_path: Path) -> None:
    """The last file of a recording has no record of its own of the run, but all of the bag's."""
    one = write(tmp_path / "one")
    two = write(tmp_path / "two", first=300, run=OTHER, max_file_size=30_000)
    folder = put(tmp_path / "dl", (one, "x_0.mcap"))
    shutil.copyfile(max(two.glob("*.mcap")), folder / "x_1.mcap")
    with pytest.raises(UserError, match=r"x_1\.mcap has another commit, another run_info"):
        recover_bag(folder)
    # A damaged file is not followed by another recording either.
    folder = put(tmp_path / "other", (one, "x_0.mcap"), (two, "x_2.mcap"))
    damage(folder / "x_0.mcap")
    with pytest.raises(UserError, match=r"x_2\.mcap is the beginning of a recording"):
        recover_bag(folder)


def test_files_of_a_recording(tmp_path: Path) -> None:
    dated = "2026-03-01_10-20-30_x.mcap"
    table = {
        "bag_0.mcap bag_10.mcap bag_2.mcap": [*(f"bag_{n}.mcap" for n in (0, 1, 2, 3, 10))],
        "x.mcap bag_3.mcap": ["bag_3.mcap"],
        "x_1.mcap.zstd x_1.mcap x_2.mcap.zstd": ["x_1.mcap", "x_2.mcap.zstd"],
        f"x_0.mcap.damaged ._x_0.mcap x_0.db3 {dated}": [dated],
        "": [],
    }
    for number, (names, found) in enumerate(table.items()):
        folder = tmp_path / str(number) / "bag"
        folder.mkdir(parents=True)
        for name in names.split():
            (folder / name).write_bytes(b"")
        assert [file.name for file in recording_files(folder)] == found
    # Metadata that name none of the files.
    path = write(tmp_path / "bag", 30)
    (path / "bag_0.mcap").rename(path / "monday.mcap")
    with pytest.raises(UserError, match=r"nothing comes before bag_0\.mcap \(it is missing\)"):
        recover_bag(path)
