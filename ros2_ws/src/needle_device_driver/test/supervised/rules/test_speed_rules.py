"""Rules for speed and travel of an axis, named as in docs/safety.md."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest

from needle_device_driver.axes.speed_monitor import SpeedMonitor
from needle_device_driver.cia402.drive_monitor import Feedback
from needle_device_driver.parameters import DeviceDriverParameters

from ..drive_bench import RAD, DriveBench

PERIOD = 0.02
# Counts in a cycle at 1 mm/s.
MM_S = 400


def until_fault(bench: DriveBench, rule: str) -> str:
    """Run cycles until a fault of this rule; return its text."""
    for _ in range(1000):
        if bench.state == "FAULT":
            break
        bench.wait()
    assert bench.rule == rule
    at = bench.positions
    bench.wait(10)
    # Plus the cycle under way.
    assert abs(bench.positions[0] - at[0]) <= 150 * MM_S
    return bench.status.fault


# ---- speed --------------------------------------------------------------------------------------


@pytest.mark.parametrize("mm_s", [-150.0, 150.0, -3.55])
def test_axis_speed_stops_a_fast_homing_in_two_cycles(mm_s: float) -> None:
    bench = DriveBench()
    way = round(mm_s * MM_S)
    bench.insertion.searches(forever=way)
    bench.homing()
    while not bench.insertion.position:
        bench.wait()
    bench.wait()
    assert bench.state == "MOVING", "once is not twice"
    bench.bus.sent.clear()
    bench.wait()
    stops = [cob for cob, data in bench.bus.sent if data[:1] == b"\x02"]
    assert (bench.state, stops) == ("FAULT", [0x201, 0x202])
    text = f"insertion axis: moves at {abs(mm_s):.4g} mm/s, limit 3.5 mm/s at 2 mm/s comm"
    assert text in until_fault(bench, "axis_speed")
    # Two observed cycles, plus the cycle under way.
    assert abs(bench.insertion.position) == 3 * abs(way)
    assert bench.insertion.state == bench.rotation.state == "disabled"
    assert bench.reset().success


def test_axis_speed_allows_homing_with_lost_answers() -> None:
    for mm_s, loses, state in ((-3.45, 0, "MOVING"), (-2.0, 1, "MOVING"), (-20.0, 1, "FAULT")):
        bench = DriveBench()
        bench.insertion.searches(forever=round(mm_s * MM_S))
        bench.homing()
        for _ in range(10):
            bench.wait(3)
            bench.insertion.loses = loses
            bench.wait()
        assert bench.state == state, bench.status.fault


def test_axis_speed_ignores_the_new_zero_at_home() -> None:
    bench = DriveBench()
    bench.insertion.position = 1_234_567
    bench.homed()
    # The homing ends after its new zero, as with a latched edge.
    bench.insertion.position = 500_000
    bench.wait(5)
    bench.insertion.searches(*[-2 * MM_S] * 20, -2_000_000, *[MM_S // 2] * 20)
    assert bench.home().success
    bench.wait(60)
    assert bench.state == "MOVING", bench.status.fault


def test_axis_speed_of_the_rotation_axis() -> None:
    for rad_s, state in ((1.59, "MOVING"), (1.61, "FAULT")):
        bench = DriveBench(rotation_homing_method=19)
        bench.rotation.searches(forever=round(rad_s * PERIOD * RAD))
        bench.insertion.searches()
        bench.homing()
        bench.wait(30)
        assert bench.state == state
    assert "rotation axis: moves at 1.611 rad/s, limit 1.6 rad/s" in bench.status.fault


@pytest.mark.parametrize("drive", ["cia402", "hand"])
def test_axis_speed_ignores_axes_without_power_or_motor(drive: str) -> None:
    bench = DriveBench(insertion_drive=drive).configured()
    for _ in range(20):
        bench.insertion.position += 100 * MM_S
        bench.wait()
    assert bench.state == "DISABLED"


class Answers:
    """Feedback of an axis at a speed."""

    def __init__(self) -> None:
        settings = DeviceDriverParameters(link="virtual", channel="test").axis("insertion")
        self.watch = SpeedMonitor(settings, PERIOD)
        self.at = Feedback(0, 0, 0, 0, 0, 0)

    def answer(
        self, mm: float, syncs: int = 1, numbers: int = 1, seconds: float = PERIOD, to: float = 2e-3
    ) -> bool:
        """Return whether the next answer is plausible at a commanded speed [m/s]."""
        before = self.at
        self.at = dataclasses.replace(
            before,
            number=before.number + numbers,
            position=before.position + round(mm * 2e4),
            syncs=before.syncs + syncs,
            time=before.time + seconds,
        )
        self.watch.command(to)
        moved = (self.at.position - before.position) / 20_000_000
        return self.watch.check(moved, self.at.periods_since(before, PERIOD), powered=True)


def test_axis_speed_uses_elapsed_sync_periods() -> None:
    for syncs, numbers, seconds, periods in (
        # Jitter of an answer is ignored, that of a SYNC up to half a period.
        (1, 1, 0.001, 1),
        (1, 1, 0.029, 1),
        (1, 1, 0.031, 2),
        # An unanswered SYNC; two answers after one SYNC; a stalled driver.
        (2, 1, 0.040, 2),
        (1, 2, 0.020, 2),
        (0, 1, 0.005, 1),
        (1, 1, 0.100, 5),
        # A simulation faster than real time.
        (3, 1, 0.001, 3),
    ):
        answers = Answers()
        bound = 3.5 * PERIOD * periods
        for share, plausible in ((0.99, True), (1.01, False), (-1.01, False)):
            assert answers.answer(share * bound, syncs, numbers, seconds) is plausible
        assert answers.watch.problem


def test_axis_speed_tolerates_one_fast_cycle() -> None:
    answers = Answers()
    for mm in (1.0, 0.04) * 5:
        answers.answer(mm)
        assert not answers.watch.problem
    # Ten cycles are a time constant: 0.5 mm/s, and 3 mm/s that decay.
    for _ in range(10):
        answers.answer(0.0, to=0.0)
    assert answers.answer((0.5 + 3.0 * math.exp(-1.1)) * PERIOD - 1e-4, to=0.0)
    assert not answers.answer((0.5 + 3.0 * math.exp(-1.2)) * PERIOD + 1e-4, to=0.0)
    for mm in (1.0, 1.0):
        answers.answer(mm, to=0.0)
    assert "moves at" in answers.watch.problem
    answers.watch.reset()
    assert answers.watch.problem == ""
    assert not answers.answer(0.51 * PERIOD, to=0.0)


# ---- distance of a homing -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parameters", "most_mm"),
    [
        ({}, 12.0),
        # A screw of 1 mm, from the drive or the parameter; a method without index pulse.
        ({"insertion_homing_method": 1}, 13.0),
        ({"insertion_homing_method": 33}, 13.0),
        ({"insertion_homing_method": 2, "insertion_counts_per_turn": 40_000.0}, 14.0),
        ({"insertion_homing_method": 20}, 12.0),
    ],
)
def test_homing_time_bounds_the_distance_by_the_travel(
    parameters: dict[str, Any], most_mm: float
) -> None:
    bench = DriveBench(max_depth=0.01, **parameters)
    bench.insertion.set_objects({(0x608F, 1): 20_000, (0x608F, 2): 1})
    bench.insertion.searches(forever=-3 * MM_S)
    bench.homing()
    text = f"without finding home, limit {most_mm:.4g} mm"
    assert text in until_fault(bench, "homing_time")
    # One observed cycle, plus the cycle under way.
    assert most_mm < abs(bench.insertion.position) / 2e4 <= most_mm + 2 * 0.06


@pytest.mark.parametrize(("method", "switch"), [(17, 1), (18, 2)])
def test_homing_time_stops_a_drive_that_moves_away_from_its_switch(
    method: int, switch: int
) -> None:
    away = 1 if method == 17 else -1
    for reverse in (False, True):
        bench = DriveBench(insertion_homing_method=method, insertion_reverse=reverse)
        bench.insertion.searches(forever=away * 2 * MM_S)
        # The other switches do not matter.
        bench.insertion.inputs = 7 - switch
        bench.homing()
        text = f"away from the limit switch of homing method {method}"
        assert text in until_fault(bench, "homing_time")
        assert 10_000 < abs(bench.insertion.position) <= 10_000 + 3 * MM_S, "0.5 mm, two cycles"
    # Off its switch the axis moves the other way; a drive without inputs is not checked.
    for works in (True, False):
        bench = DriveBench(insertion_homing_method=method)
        if not works:
            bench.insertion.missing_objects = {0x60FD}
        bench.insertion.inputs = switch * works
        bench.insertion.searches(forever=away * MM_S)
        bench.homing()
        bench.wait(10)
        bench.insertion.inputs = 0
        bench.wait(60)
        assert abs(bench.insertion.position) > 20_000
        assert bench.state == "MOVING", bench.status.fault


def test_homing_time_is_not_the_rule_of_a_reported_failure() -> None:
    bench = DriveBench()
    bench.insertion.searches()
    bench.homing()
    bench.wait(6)
    bench.insertion.more_status = 0x2000
    bench.wait()
    assert (bench.state, bench.rule) == ("FAULT", "one_fault_stops_both")
    assert bench.status.fault == "insertion axis: the drive reports that homing failed"
    assert bench.insertion.state == "quick stop"
