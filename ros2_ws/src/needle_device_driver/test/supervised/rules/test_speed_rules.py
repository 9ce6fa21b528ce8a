"""Rules for speed and travel of an axis, named as in docs/safety.md."""

from __future__ import annotations

import math
from typing import Any

import pytest

from needle_device_driver.axes.speed_monitor import SpeedMonitor
from needle_device_driver.cia402.drive_monitor import Feedback
from needle_device_driver.parameters import DeviceDriverParameters

from ..drive_bench import DriveBench

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


@pytest.mark.parametrize("mm_s", [150.0, -3.55])
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


@pytest.mark.parametrize("drive", ["cia402", "hand"])
def test_axis_speed_ignores_axes_without_power_or_motor(drive: str) -> None:
    bench = DriveBench(insertion_drive=drive).configured()
    for _ in range(20):
        bench.insertion.position += 100 * MM_S
        bench.wait()
    assert bench.state == "DISABLED"


def speed_monitor(axis: str = "insertion") -> SpeedMonitor:
    settings = DeviceDriverParameters(link="virtual", channel="test").axis(axis)
    return SpeedMonitor(settings, PERIOD)


def test_axis_speed_uses_elapsed_sync_periods() -> None:
    for answer, periods in (
        # Jitter of an answer is ignored, that of a SYNC up to half a period.
        (Feedback(syncs=1, number=1, time=0.001), 1),
        (Feedback(syncs=1, number=1, time=0.029), 1),
        (Feedback(syncs=1, number=1, time=0.031), 2),
        # An unanswered SYNC; two answers after one SYNC; a stalled driver.
        (Feedback(syncs=2, number=1, time=0.040), 2),
        (Feedback(syncs=1, number=2, time=0.020), 2),
        (Feedback(syncs=0, number=1, time=0.005), 1),
        (Feedback(syncs=1, number=1, time=0.100), 5),
        # A simulation faster than real time.
        (Feedback(syncs=3, number=1, time=0.001), 3),
    ):
        assert answer.periods_since(Feedback(), PERIOD) == periods
    for axis, commanded, bound in (("insertion", 0.002, 0.0035), ("rotation", 1.0, 1.6)):
        for share, plausible in ((0.99, True), (1.01, False), (-1.01, False)):
            monitor = speed_monitor(axis)
            monitor.command(commanded)
            assert monitor.check(share * bound * 5 * PERIOD, 5, powered=True) is plausible


def test_axis_speed_tolerates_one_fast_cycle() -> None:
    monitor = speed_monitor()

    def is_plausible(speed: float) -> bool:
        return monitor.check(speed * PERIOD, 1, powered=True)

    for speed in (0.05, 0.002) * 5:
        monitor.command(0.002)
        is_plausible(speed)
        assert not monitor.problem
    # Ten cycles are a time constant: 0.5 mm/s, and 3 mm/s that decay.
    for _ in range(10):
        is_plausible(0.0)
    assert is_plausible(0.0005 + 0.003 * math.exp(-1.1) - 1e-5)
    assert not is_plausible(0.0005 + 0.003 * math.exp(-1.2) + 1e-5)
    is_plausible(0.05)
    assert "moves at" in monitor.problem
    monitor.reset()
    assert (monitor.problem, is_plausible(0.00051)) == ("", False)


# ---- distance of a homing -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parameters", "most_mm"),
    [
        ({}, 12.0),
        # One turn more to the index pulse: a screw of 1 mm, from the drive or the parameter.
        ({"insertion_homing_method": 1}, 13.0),
        ({"insertion_homing_method": 2, "insertion_counts_per_turn": 40_000.0}, 14.0),
    ],
)
def test_homing_time_bounds_the_distance_by_the_travel(
    parameters: dict[str, Any], most_mm: float
) -> None:
    bench = DriveBench(max_depth=0.01, **parameters)
    bench.insertion.set_objects({(0x608F, 1): 20_000, (0x608F, 2): 1})
    bench.insertion.searches(forever=-3 * MM_S)
    bench.homing()
    assert f"without finding home, limit {most_mm:.4g} mm" in until_fault(bench, "homing_time")
    # One observed cycle, plus the cycle under way.
    assert most_mm < abs(bench.insertion.position) / 2e4 <= most_mm + 2 * 0.06


@pytest.mark.parametrize(("method", "switch", "away"), [(17, 1, 1), (18, 2, -1)])
def test_homing_time_stops_a_drive_that_moves_away_from_its_switch(
    method: int, switch: int, away: int
) -> None:
    # The direction counts in the drive, not on the axis; the other switches do not matter.
    bench = DriveBench(insertion_homing_method=method, insertion_reverse=True)
    bench.insertion.searches(forever=away * 2 * MM_S)
    bench.insertion.inputs = 7 - switch
    bench.homing()
    text = f"away from the limit switch of homing method {method}"
    assert text in until_fault(bench, "homing_time")
    assert 10_000 < abs(bench.insertion.position) <= 10_000 + 3 * MM_S, "0.5 mm, two cycles"


@pytest.mark.parametrize("missing", [set(), {0x60FD}], ids=["on its switch", "without inputs"])
def test_homing_time_allows_either_direction(missing: set[int]) -> None:
    bench = DriveBench(insertion_homing_method=17)
    bench.insertion.missing_objects = missing
    bench.insertion.inputs = 0 if missing else 1
    bench.insertion.searches(forever=MM_S)
    bench.homing()
    bench.wait(10)
    bench.insertion.inputs = 0
    bench.wait(60)
    assert bench.insertion.position > 20_000
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
