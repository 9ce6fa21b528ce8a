"""What the driver sends as in the frozen transcripts (tests/oracles/can), and the motors' paths.

Driver and drives get the frozen runs' first commands. Where motors move with SYNC, what a drive
answers does not depend on how long a frame takes: requests and process data are equal, without
tolerance.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np

from needle_bags.reading.bag_files import read_messages
from needle_core import messages as m
from needle_core.component import Publish
from needle_core.convert import from_ros

from .component_bench import ComponentBench

ORACLES = Path(__file__).resolve().parents[5] / "tests" / "oracles"
COMMANDS, POSITIONS, RESULTS = "/device/joint_trajectory", "/sim/drive_positions", "/device/result"
# Who a drive is, asked until it answers and again before lock step: how often is no matter.
WHO_ARE_YOU = ("40001000", "40081000", "60000000", "70000000")
# In lock step driver and drives waited 5 s for each other, now 0.1 s.
WATCHDOG = {"2316100188137F00": "2316100164007F00"}
REQUESTS, PROCESS_DATA = (0x601, 0x602), (0x201, 0x202, 0x301, 0x302)
STEPS, CONTINUOUS = 6, 60
MOTOR_PATH = 10e-6
"""Largest distance of the motors from the frozen path [m]; a needle turns 1 mm of arc a rad."""
ARC = 1e-3


def recorded(name: str, topic: str, kind: type[Any]) -> list[Any]:
    messages = read_messages(ORACLES / "bags" / name, topic.__eq__)
    return [from_ros(kind, message) for _, _, message in messages]


def send(bench: ComponentBench, command: m.Trajectory) -> None:
    stamp_ns = 1_000_000_000 + round(bench.runner.now * 1e9)
    own = m.Trajectory(stamp_ns, command.joint_names, command.points)
    bench.person.actions.append(Publish("device/joint_trajectory", own))


def distances(points: Any, line: Any) -> Any:
    """Return the distance of each point from a line of points."""
    points, line = points * (1.0, ARC), line * (1.0, ARC)
    line = line[np.r_[True, np.any(np.diff(line, axis=0) != 0.0, axis=1)]]
    begin, along = line[:-1], np.diff(line, axis=0)
    share = ((points[:, None] - begin) * along).sum(-1) / (along**2).sum(-1)
    foot = begin + np.clip(share, 0.0, 1.0)[..., None] * along
    return np.linalg.norm(points[:, None] - foot, axis=-1).min(1)


def test_stepwise_each_drive_is_told_and_asked_the_same() -> None:
    bench = ComponentBench()
    bench.ready()
    for command in recorded("drive_best", COMMANDS, m.Trajectory)[:STEPS]:
        bench.person.outcomes.clear()
        send(bench, command)
        bench.until(lambda: bench.person.outcomes == ["succeeded"])
    lines = (ORACLES / "can" / "drive_best.txt").read_text("utf-8").splitlines()
    for cob_id in REQUESTS + PROCESS_DATA:
        frozen = [line.partition("#")[2] for line in lines if line.startswith(f"{cob_id:03X}")]
        sent = [frame.data.hex().upper() for _, frame in bench.sent(cob_id)]
        if cob_id in REQUESTS:
            sent, frozen = (
                [WATCHDOG.get(each, each) for each in frames if not each.startswith(WHO_ARE_YOU)]
                for frames in (sent, frozen)
            )
        else:
            sent = [each for each, _ in itertools.groupby(sent)]
        least = 5 if cob_id in (0x201, 0x202) else 30
        assert len(sent) > least, hex(cob_id)
        assert sent == frozen[: len(sent)], hex(cob_id)


def test_continuously_the_motors_go_the_same_way() -> None:
    name = "drive_best_continuous"
    commands = recorded(name, COMMANDS, m.Trajectory)[:CONTINUOUS]
    bench = ComponentBench()
    bench.ready()
    begin, way = bench.runner.now, [bench.places]
    for command in commands:
        # A path begins where the needle was at its exposure; by then it is a little farther.
        due = begin + (command.stamp_ns - commands[0].stamp_ns) * 1e-9 + 0.1
        while bench.runner.now < due:
            bench.run(0.01)
            way.append(bench.places)
        send(bench, command)
    results = recorded(name, RESULTS, m.CommandResult)[: len(bench.person.outcomes)]
    assert len(results) > CONTINUOUS - 3
    assert bench.person.outcomes == [result.outcome for result in results]
    reached = way[-1][0]
    wanted = [
        message.positions
        for message in recorded(name, POSITIONS, m.JointState)
        if message.positions[0] < reached
    ]
    assert len(wanted) > CONTINUOUS
    assert distances(np.array(wanted), np.array(way)).max() < MOTOR_PATH
