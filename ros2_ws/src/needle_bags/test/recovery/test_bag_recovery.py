"""`recover` repairs bags, reports the loss, and changes nothing if it fails."""

from __future__ import annotations

import contextlib
import json
import resource
import shutil
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as OtherWriter

from needle_bags.format.bag_writer import BagWriter, standard_topic, string_message
from needle_bags.reading.bag_messages import read_contents, read_messages
from needle_bags.reading.bag_reader import read_run
from needle_bags.recovery import bag_recovery, recover
from needle_bags.recovery.bag_recovery import recover_bag
from needle_core.errors import UserError

from .numbered_bag import START, STEP, TOPICS, chunks, contents, damage, kill, numbers, write

STRING = standard_topic("/a", "std_msgs/msg/String")


def test_a_killed_recording_is_recovered(tmp_path: Path) -> None:
    path = kill(write(tmp_path / "bag"))
    before = contents(path)
    with pytest.raises(UserError, match=rf"run `ros2 run needle_bags recover {path}`$"):
        read_run(path)
    recovery = recover_bag(path)
    assert not recovery.was_whole
    assert numbers(path) == list(range(recovery.messages))
    assert recovery.messages > 200
    assert "(the file ends inside a record) on: half a second at most if" in recovery.lost
    recovered = read_contents(path)
    custom = recovered.custom_data
    assert (custom["commit"], custom["run_info"]) == ("0123abc", "seed: 3")
    assert yaml.safe_load(custom["parameters"])["/two"]["ros__parameters"]["gain"] == 2.5
    (change,) = yaml.safe_load(custom["parameter_changes"])
    assert (change["stamp_ns"], change["value"]) == (5, 2.0)
    assert custom["recovered"] == recovery.lost
    assert (recovered.distribution, recovered.topics["/one"]) == ("jazzy", TOPICS[0])
    with (path / "bag_0.mcap").open("rb") as stream:
        assert [a.data for a in make_reader(stream).iter_attachments()] == [b"left: {}\n"]
    assert (path / "bag_0.mcap.damaged").read_bytes() == before["bag_0.mcap"]
    assert recover_bag(path).was_whole


def test_without_metadata_everything_is_recovered_in_order(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", max_file_size=3000)
    assert len(list(path.glob("*.mcap"))) > 10
    documents = [yaml.safe_load((path / "metadata.yaml").read_text())]
    (path / "metadata.yaml").unlink()
    recovery = recover_bag(path)
    assert (recovery.messages, recovery.lost, recovery.kept) == (300, "", [])
    documents.append(yaml.safe_load((path / "metadata.yaml").read_text()))
    before, after = (one["rosbag2_bagfile_information"] for one in documents)
    # Parameters come from the data, and a note is added.
    assert before.pop("custom_data").items() <= after.pop("custom_data").items()
    assert after == before
    assert numbers(path) == list(range(300))
    # The same with malformed or empty metadata.
    for text in ("rosbag2_bagfile_information: [1, {", ""):
        (path / "metadata.yaml").write_text(text)
        (kept,) = recover_bag(path).kept
        assert (path / kept).read_text() == text
    assert read_contents(path).counts.total() == 300


def test_the_command_reports_the_loss_and_leaves_a_whole_bag(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "bag")
    before = contents(path)
    assert recover.main([str(path)]) == 0
    assert "is complete: 300 messages of 3 topics; nothing to do" in capsys.readouterr().out
    assert contents(path) == before
    first = damage(path / "bag_0.mcap")
    assert recover.main([str(path), "--json", str(tmp_path / "out.json")]) == 0
    output = capsys.readouterr().out
    kept = len(numbers(path))
    values = json.loads((tmp_path / "out.json").read_text())
    assert (values["messages"], values["lost_s"]) == (kept, pytest.approx((300 - kept) / 100))
    assert kept <= first < kept + 60
    assert f"recovered {path}: {kept} messages of 3 topics" in output
    assert f"CRCValidationError) on: {(300 - kept) / 100:.1f} s follow" in output
    assert "delete them when done: metadata.yaml.damaged, bag_0.mcap.damaged" in output


def test_a_bag_that_is_being_recorded_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    bag = BagWriter(path)
    for act in (recover_bag, read_run):
        for named in (path, path / "bag_0.mcap"):
            with pytest.raises(UserError, match="still being recorded"):
                act(named)
    bag.close()
    assert recover_bag(path).was_whole


def test_messages_compressed_one_by_one_are_recovered(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    writer = OtherWriter(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    definition: Any = {"msgdef": STRING.definition, "rihs01": STRING.type_hash}
    with writer:
        topic = writer.add_connection("/a", STRING.type_name, **definition)
        for number in range(30):
            writer.write(topic, 1000 + number, string_message(f"message {number}"))
    (path / "metadata.yaml").unlink()
    assert recover_bag(path).kept == []
    messages = read_messages(path, "/a".__eq__)
    assert [m.data for _, _, m in messages] == [f"message {k}" for k in range(30)]


def test_the_cause_of_an_unrecoverable_bag_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    damage(write(tmp_path / "damaged", 90) / "damaged_0.mcap", share=0.0)
    for name, words in {
        "empty": "is not a bag",
        "missing": "no such bag directory",
        "damaged": "it has no data before byte",
    }.items():
        path = tmp_path / name
        before = contents(path) if path.exists() else {}
        assert recover.main([str(path)]) == 2
        assert words in capsys.readouterr().err
        assert not before or contents(path) == before


def test_without_room_for_a_copy_nothing_is_changed(tmp_path: Path) -> None:
    path = kill(write(tmp_path / "bag"))
    before = contents(path)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before["bag_0.mcap"]) // 2, limits[1]))
    try:
        with pytest.raises(UserError, match="as much space again; nothing was changed"):
            recover_bag(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert contents(path) == before


class Interruption(Exception):
    """Stand-in for a kill: nothing is cleaned up."""


@pytest.mark.parametrize(
    "step", ["_read_through", "write_metadata", "_keep_original", "sync_directory"]
)
def test_an_interrupted_recovery_can_be_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    path = write(tmp_path / "bag", 90, max_file_size=4500, chunk_size=2048)
    damage(path / "bag_1.mcap")
    before = contents(path)
    shutil.copytree(path, tmp_path / "other" / "bag")
    expected = recover_bag(tmp_path / "other" / "bag")
    act = getattr(bag_recovery, step)
    # Interrupt the first, second, ... call.
    for calls in range(100):
        shutil.rmtree(path)
        path.mkdir()
        for name, data in before.items():
            (path / name).write_bytes(data)
        interrupted = mock.Mock(wraps=act, side_effect=[mock.DEFAULT] * calls + [Interruption])
        monkeypatch.setattr(bag_recovery, step, interrupted)
        with contextlib.suppress(Interruption):
            recover_bag(path)
            assert calls >= 1
            return
        assert before["bag_1.mcap"] in contents(path).values()
        monkeypatch.setattr(bag_recovery, step, act)
        recover_bag(path)
        assert numbers(path) == list(range(expected.messages))
        assert read_contents(path).custom_data["recovered"].startswith(expected.lost)


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_everything_before_the_damage_is_recovered(tmp_path: Path, compression: str) -> None:
    whole = write(tmp_path / "whole", 80, compression=compression)
    (file,) = whole.glob("*.mcap")
    data = file.read_bytes()
    rng = np.random.default_rng(5)
    for chunk in chunks(file)[1:]:
        start = chunk.chunk_start_offset + 60 + int(rng.integers(chunk.chunk_length - 60))
        noise = data[:start] + rng.bytes(40) + data[start + 40 :]
        zeros = data[:start] + bytes(len(data) - start)
        for harmed in (data[:start], zeros, noise):
            bag = tmp_path / f"{start}_{len(harmed)}_{harmed is noise}"
            shutil.copytree(whole, bag)
            (bag / file.name).write_bytes(harmed)
            recovery = recover_bag(bag)
            kept = numbers(bag)
            before = (chunk.message_start_time - START) // STEP
            assert kept == list(range(len(kept)))
            assert before <= len(kept) < before + 40
            assert recovery.seconds_lost == pytest.approx((80 - len(kept)) * STEP / 1e9)
            shutil.rmtree(bag)


@pytest.mark.parametrize("harm", ["damaged", "missing", "missing, and no metadata"])
def test_a_bag_of_several_files_ends_at_the_first_damaged_one(tmp_path: Path, harm: str) -> None:
    bag = write(tmp_path / "bag", 240, max_file_size=11_000)
    if harm == "damaged":
        damage(bag / "bag_1.mcap")
    else:
        (bag / "bag_1.mcap").unlink()
    if "metadata" in harm:
        (bag / "metadata.yaml").unlink()
    before = contents(bag)
    recovery = recover_bag(bag)
    kept = numbers(bag)
    assert kept == list(range(len(kept)))
    assert 60 < len(kept) < 160
    assert recovery.left_out == ["bag_2.mcap"]
    assert contents(bag)["bag_2.mcap"] == before["bag_2.mcap"]
    if harm != "damaged":
        assert recovery.lost.startswith("all from bag_1.mcap (it is missing) on: ")
