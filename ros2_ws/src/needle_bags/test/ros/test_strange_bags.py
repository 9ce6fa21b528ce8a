"""Bags with strange files, before every tool that reads bags: one line, no change elsewhere."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from needle_bags.format.bag_writer import BagWriter, standard_topic
from needle_bags.reading import small_bag
from needle_bags.recovery import recover
from needle_bags.report import report
from needle_bags.ros import player as player_node
from needle_bags.ros import rerun as rerun_node

MakeRun = Callable[..., Path]
TOOLS: dict[str, Callable[[Path], int]] = {
    "report": lambda bag: report.main([str(bag)]),
    "rerun": lambda bag: rerun_node.main([str(bag)]),
    "player": lambda bag: player_node.main(["player", str(bag)]),
    "small_bag": lambda bag: small_bag.main([str(bag), str(bag.parent / "small")]),
    "recover": lambda bag: recover.main([str(bag)]),
}


def change(bag: Path, **values: object) -> None:
    document = yaml.safe_load((bag / "metadata.yaml").read_text())
    document["rosbag2_bagfile_information"].update(values)
    (bag / "metadata.yaml").write_text(yaml.safe_dump(document))


def data_pipe(bag: Path) -> None:
    (bag / "run_0.mcap").unlink()
    os.mkfifo(bag / "run_0.mcap")


def data_outside(bag: Path) -> None:
    (bag / "run_0.mcap").rename(bag.parent / "elsewhere")
    (bag / "run_0.mcap").symlink_to(bag.parent / "elsewhere")


@pytest.mark.parametrize("harm", [data_pipe, data_outside])
def test_every_command_gives_a_one_line_error_for_a_file_that_is_no_bag(
    make_run: MakeRun, capsys: pytest.CaptureFixture[str], harm: Callable[[Path], None]
) -> None:
    bag = make_run(steps=3)
    harm(bag)
    for tool in TOOLS.values():
        assert tool(bag) == 2
        said = capsys.readouterr()
        assert said.err.startswith("error: ")
        assert said.err.count("\n") == 1


def test_an_image_of_a_wrong_size_gives_a_one_line_error(
    make_run: MakeRun, capsys: pytest.CaptureFixture[str]
) -> None:
    for height in (7, 2**32 - 1):
        assert report.main([str(make_run(str(height), image_height=height, steps=3))]) == 2
        said = capsys.readouterr().err
        assert f"an image declares {height} rows of 4 pixels" in said
        assert said.count("\n") == 1


def test_links_in_a_bag_are_replaced_not_followed(make_run: MakeRun, tmp_path: Path) -> None:
    bag = make_run(steps=3)
    precious = tmp_path / "precious"
    precious.write_text("mine")
    for name in ("report.html", "states.png", "metadata.yaml.tmp"):
        (bag / name).symlink_to(precious)
    report._write(bag, {"states.png": b"png", "report.html": b"page"})
    change(bag, message_count=5)
    assert recover.main([str(bag)]) == 0
    assert precious.read_text() == "mine"
    assert not (bag / "report.html").is_symlink()
    # The recorder follows none either.
    new = tmp_path / "new"
    new.mkdir()
    (new / "metadata.yaml").symlink_to(tmp_path / "nowhere")
    writer = BagWriter(new)
    topic = writer.add_topic(standard_topic("/a", "std_msgs/msg/Header"))
    writer.write(topic, bytes([0, 1, 0, 0]) + bytes(13), 1, 1)
    writer.close()
    assert not (tmp_path / "nowhere").exists()
