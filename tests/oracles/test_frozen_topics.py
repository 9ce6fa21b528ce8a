"""Topics of a run on the virtual clock: those of the frozen bags, with listed exceptions."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from needle_bags.reading.bag_messages import read_contents
from needle_bringup.simulation.rig_configuration import command_line_parameters, run_info
from needle_bringup.simulation.simulate_options import parse
from needle_bringup.simulation.virtual_run import make_components, run_virtually

FROZEN = json.loads((Path(__file__).resolve().parent / "topics.json").read_text("utf-8"))
GONE = {
    "/clock": "the runner's time is no message: log times are virtual",
    "/device_driver/transition_event": "a component has no lifecycle of ROS",
    "/parameter_events": "parameters are fixed, and are in the bag's metadata",
}
"""Frozen topics that a virtual run lacks, and the reasons."""
ADDED = {
    "/stereo_tracker/annotated_image": "an output that stays empty without a subscriber",
    "/needle/proposed_target": "the controller receives it; no planner proposes a target",
    "/needle/planned_path": "the controller plans a path past obstacles only",
}
"""Topics that only a virtual run has, and the reasons."""


@pytest.mark.parametrize("level", ["tip", "camera", "drive"])
def test_a_run_has_every_frozen_topic_with_its_type(tmp_path: Path, level: str) -> None:
    options = parse(["--level", level, "--depth-mm", "3"])
    bag = tmp_path / "bag"
    run_virtually(
        make_components(command_line_parameters(options, bag)),
        bag,
        seed=options.seed,
        run_info=run_info(options),
        real_time_factor=0.0,
        check=lambda: None,
    )
    contents, frozen = read_contents(bag), FROZEN[level]
    today = {topic.name: topic.type_name for topic in contents.topics.values()}
    assert frozen.keys() - today.keys() == GONE.keys() & frozen.keys()
    assert today.keys() - frozen.keys() <= ADDED.keys()
    assert not any(contents.counts[name] for name in today.keys() - frozen.keys())
    assert {name: today[name] for name in frozen if name not in GONE} == {
        name: kind for name, kind in frozen.items() if name not in GONE
    }
