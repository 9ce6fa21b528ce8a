"""What the driver sends in the first steps of a frozen run is its transcript (tests/oracles/can).

Where motors move with SYNC, what a drive answers does not depend on how long a frame takes:
requests and process data are equal, without tolerance.
"""

from __future__ import annotations

import itertools
from pathlib import Path

from needle_bags.reading.bag_files import read_messages
from needle_core import messages as m
from needle_core.convert import from_ros

from .component_bench import ComponentBench

ORACLES = Path(__file__).resolve().parents[5] / "tests" / "oracles"
# Who a drive is, asked until it answers and again before lock step: how often is no matter.
WHO_ARE_YOU = ("40001000", "40081000", "60000000", "70000000")
# In lock step driver and drives waited 5 s for each other, now 0.1 s.
WATCHDOG = {"2316100188137F00": "2316100164007F00"}


def told(frames: list[str]) -> list[str]:
    return [WATCHDOG.get(each, each) for each in frames if not each.startswith(WHO_ARE_YOU)]


def test_each_drive_is_told_and_asked_the_same() -> None:
    bench = ComponentBench()
    bench.home()
    bench.arm()
    commands = read_messages(ORACLES / "bags" / "drive_best", "/device/joint_trajectory".__eq__)
    for number, (_, _, message) in enumerate(itertools.islice(commands, 6)):
        points = from_ros(m.Trajectory, message).points
        stamp_ns = 1_000_000_000 + round(bench.runner.now * 1e9)
        names = (m.INSERTION_JOINT, m.ROTATION_JOINT)
        bench.publish("device/joint_trajectory", m.Trajectory(stamp_ns, names, points))
        bench.until(lambda: len(bench.outcomes) > number)  # noqa: B023 - called at once
    assert bench.outcomes == ["succeeded"] * 6
    lines = (ORACLES / "can" / "drive_best.txt").read_text("utf-8").splitlines()
    for cob_id, least in (
        (0x601, 30),
        (0x602, 30),
        (0x201, 5),
        (0x202, 5),
        (0x301, 30),
        (0x302, 30),
    ):
        frozen = told([line[4:] for line in lines if line.startswith(f"{cob_id:03X}#")])
        sent = told([frame.data.hex().upper() for _, frame in bench.sent(cob_id)])
        if cob_id < 0x600:
            sent = [each for each, _ in itertools.groupby(sent)]
        assert len(sent) > least, hex(cob_id)
        assert sent == frozen[: len(sent)], hex(cob_id)
