"""Today's controller on the inputs of the frozen bags: its output is the recorded one."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_bags.reading.bag_messages import read_contents
from needle_bags.ros import rerun

BAGS = Path(__file__).resolve().parent / "bags"
NAMES = (
    "tip_best",
    "tip_paper",
    "tip_open_loop",
    "tip_best_continuous",
    "tip_best_noiseless",
    "tip_best_seed_2",
    "camera_best",
    "drive_best",
    "drive_best_continuous",
)
STEPS = 40


def test_every_frozen_bag_is_run_again() -> None:
    assert {folder.name for folder in BAGS.iterdir()} == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_the_controller_reproduces_the_recorded_output(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    counts = read_contents(BAGS / name).counts
    for topic in ("needle/tip_pose", "needle/estimate", "needle/control_input"):
        assert counts[f"/{topic}"] >= STEPS, topic
    assert rerun.main([str(BAGS / name)]) == 0, capsys.readouterr().out
    assert "UNCHANGED" in capsys.readouterr().out
