"""How fast and how far an axis goes that its drive moves, named as in docs/safety.md."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable

import pytest

from needle_device_driver.cia402.axis_speed import SpeedWatch
from needle_device_driver.cia402.drive_monitor import Feedback
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.states import State

from ..checks import in_state
from ..drive_bench import DriveBench
from ..scripted_drives import ScriptedDrive

PERIOD = 0.02
Make = Callable[..., DriveBench]
# Counts in a cycle at 1 mm/s.
MM_S = 400


def searches(drive: ScriptedDrive, ways: Iterable[int]) -> None:
    """Let a drive go so many counts a cycle while it homes, and never find its home."""
    drive.home_after = 10**9
    sync, rest = drive.sync, iter(ways)

    def moving() -> None:
        sync()
        if drive.homing_for >= 0 and drive.state == "enabled":
            drive.position += next(rest, 0)

    drive.sync = moving  # type: ignore[method-assign]


def homing(bench: DriveBench) -> None:
    bench.configured()
    bench.supervisor.confirm_needle_out(True)
    assert bench.run(bench.supervisor.home(bench.clock())).success


def until_fault(bench: DriveBench, most: int = 1000) -> None:
    for _ in range(most):
        if in_state(bench, State.FAULT):
            return
        bench.cycle(1)
    raise AssertionError(f"no fault: {bench.positions}")


# ---- speed -------------------------------------------------------------------------------------


@pytest.mark.parametrize("mm_s", [-150.0, 150.0, -4.0, -3.6])
def test_axis_speed_a_homing_that_is_too_fast_is_stopped_in_two_cycles(
    drive_bench: DriveBench, mm_s: float
) -> None:
    bench = drive_bench
    way = round(mm_s * MM_S)
    searches(bench.insertion, itertools.repeat(way))
    homing(bench)
    until_fault(bench)
    assert bench.notices[-1].rule is Rule.AXIS_SPEED
    assert f"insertion axis: moves at {abs(mm_s):.4g} mm/s, at most 3.5 mm/s" in bench.status.fault
    assert "2 mm/s are commanded" in bench.status.fault
    assert bench.insertion.state == "quick stop"
    # Two cycles that are seen, one that was under way.
    assert abs(bench.insertion.position) <= 3 * abs(way)
    at = bench.positions
    bench.cycle(10)
    assert bench.positions == at
    assert bench.insertion.state == bench.rotation.state == "disabled"
    assert bench.run(bench.supervisor.reset(bench.clock())).success


def test_axis_speed_stops_both_in_the_cycle_that_shows_it(drive_bench: DriveBench) -> None:
    bench = drive_bench
    searches(bench.insertion, itertools.repeat(-40 * MM_S))
    searches(bench.rotation, itertools.repeat(0))
    homing(bench)
    while not bench.insertion.position:
        bench.cycle(1)
    bench.cycle(1)
    assert in_state(bench, State.MOVING), "once is not twice"
    sent = len(bench.bus.sent)
    bench.cycle(1)
    assert in_state(bench, State.FAULT)
    stops = [cob for cob, data in bench.bus.sent[sent:] if data[:1] == b"\x02"]
    assert stops == [0x201, 0x202]


@pytest.mark.parametrize("mm_s", [-2.0, -3.4])
def test_axis_speed_a_homing_at_its_speed_goes_on(drive_bench: DriveBench, mm_s: float) -> None:
    bench = drive_bench
    searches(bench.insertion, itertools.repeat(round(mm_s * MM_S)))
    homing(bench)
    bench.cycle(60)
    assert in_state(bench, State.MOVING), bench.status.fault


def test_axis_speed_a_drive_that_counts_anew_at_its_home_is_not_fast(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.insertion.position = 1_234_567
    bench.homed()
    # A homing whose end comes later than its new count, as where the edge is latched.
    ways = [-2 * MM_S] * 20 + [-2_000_000] + [MM_S // 2] * 20
    bench.insertion.position = 500_000
    bench.cycle(5)
    searches(bench.insertion, ways)
    bench.supervisor.confirm_needle_out(True)
    assert bench.run(bench.supervisor.home(bench.clock())).success
    bench.cycle(60)
    assert in_state(bench, State.MOVING), bench.status.fault


@pytest.mark.parametrize(("rad_s", "fast"), [(1.55, False), (1.65, True)])
def test_axis_speed_of_the_rotation_axis(make_drive_bench: Make, rad_s: float, fast: bool) -> None:
    bench = make_drive_bench(rotation_homing_method=19)
    searches(bench.rotation, itertools.repeat(round(rad_s * PERIOD * 65536 / 6.283185307)))
    searches(bench.insertion, itertools.repeat(0))
    homing(bench)
    bench.cycle(30)
    assert in_state(bench, State.FAULT if fast else State.MOVING)
    assert not fast or "rotation axis: moves at 1.649 rad/s, at most 1.6" in bench.status.fault


@pytest.mark.parametrize(("mm_s", "fast"), [(0.45, False), (0.55, True)])
def test_axis_speed_an_axis_that_drifts_while_nothing_is_commanded(
    drive_bench: DriveBench, mm_s: float, fast: bool
) -> None:
    bench = drive_bench
    bench.ready()
    # What was commanded before fades.
    bench.cycle(50, holding=True)
    for _ in range(4):
        bench.insertion.left_over += round(mm_s * MM_S)
        bench.cycle(1, holding=True)
    assert in_state(bench, State.FAULT if fast else State.HOLDING)
    assert not fast or bench.notices[-1].rule is Rule.AXIS_SPEED


def test_axis_speed_an_axis_that_is_off_may_be_moved_by_hand(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.configured()
    for _ in range(20):
        bench.insertion.position += 100 * MM_S
        bench.cycle(1)
    assert in_state(bench, State.DISABLED)


def test_axis_speed_an_axis_that_a_hand_moves_is_not_judged(make_drive_bench: Make) -> None:
    bench = make_drive_bench(insertion_drive="hand")
    bench.ready()
    bench.cycle(1, holding=True)
    bench.step()
    for _ in range(4):
        bench.insertion.position += 10 * MM_S
        bench.cycle(1, holding=True)
    assert not in_state(bench, State.FAULT)


def test_axis_speed_answers_that_are_lost_are_time_that_went_by(drive_bench: DriveBench) -> None:
    bench = drive_bench
    searches(bench.insertion, itertools.repeat(-2 * MM_S))
    homing(bench)
    for _ in range(20):
        bench.cycle(1)
        bench.insertion.loses = 1
        bench.cycle(1)
    assert in_state(bench, State.MOVING), bench.status.fault


def test_axis_speed_a_fast_axis_whose_answers_are_lost_is_fast_all_the_same(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    searches(bench.insertion, itertools.repeat(-20 * MM_S))
    homing(bench)
    for _ in range(10):
        bench.cycle(3)
        bench.insertion.loses = 1
        bench.cycle(1)
    assert bench.notices[-1].rule is Rule.AXIS_SPEED


class Answers:
    """Feedback of an axis that goes at a speed, by the time of each answer."""

    def __init__(self) -> None:
        settings = DeviceDriverParameters(link="virtual", channel="test").drive("insertion")
        self.watch = SpeedWatch(dataclasses.replace(settings, counts_per_unit=2e7), PERIOD)
        self.at = Feedback(0, 0, 0, 0, 0, 0)

    def answer(self, *, mm: float, syncs: int, numbers: int, seconds: float) -> bool:
        """Return whether the next answer is plausible."""
        before = self.at
        self.at = dataclasses.replace(
            before,
            number=before.number + numbers,
            position=before.position + round(mm * 2e4),
            syncs=before.syncs + syncs,
            time=before.time + seconds,
        )
        self.watch.command(0.002)
        return self.watch.judge(before, self.at, powered=True)


@pytest.mark.parametrize(
    ("syncs", "numbers", "seconds", "periods"),
    [
        (1, 1, 0.020, 1),
        # Jitter of an answer counts for nothing, that of a SYNC by half its period.
        (1, 1, 0.001, 1),
        (1, 1, 0.029, 1),
        (1, 1, 0.031, 2),
        # A SYNC that was not answered; two answers after one SYNC; a driver that stood still.
        (2, 1, 0.040, 2),
        (1, 2, 0.020, 2),
        (0, 1, 0.005, 1),
        (1, 1, 0.100, 5),
        # A simulation that is faster than its time.
        (3, 1, 0.001, 3),
    ],
)
def test_axis_speed_is_judged_by_elapsed_sync_periods(
    syncs: int, numbers: int, seconds: float, periods: int
) -> None:
    answers = Answers()
    bound = 3.5 * PERIOD * periods
    for share, plausible in ((0.99, True), (1.01, False), (-1.01, False)):
        told = answers.answer(mm=share * bound, syncs=syncs, numbers=numbers, seconds=seconds)
        assert told is plausible
    assert answers.watch.trouble


def test_axis_speed_once_too_fast_is_forgiven_and_twice_is_not() -> None:
    answers = Answers()
    for mm in (1.0, 0.04) * 5:
        answers.answer(mm=mm, syncs=1, numbers=1, seconds=PERIOD)
        assert not answers.watch.trouble
    for mm in (1.0, 1.0):
        answers.answer(mm=mm, syncs=1, numbers=1, seconds=PERIOD)
    assert "moves at 50 mm/s" in answers.watch.trouble


# ---- way of a homing ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parameters", "most_mm"),
    [
        ({"max_depth": 0.01}, 12.0),
        ({"max_depth": 0.002}, 2.4),
        # A screw of 1 mm, that the drive tells or the parameter; a method without index pulse.
        ({"max_depth": 0.01, "insertion_homing_method": 1}, 13.0),
        ({"max_depth": 0.01, "insertion_homing_method": 33}, 13.0),
        (
            {
                "max_depth": 0.01,
                "insertion_homing_method": 2,
                "insertion_counts_per_turn": 40_000.0,
            },
            14.0,
        ),
        ({"max_depth": 0.01, "insertion_homing_method": 20}, 12.0),
    ],
)
def test_homing_time_an_axis_goes_no_farther_than_its_own_travel_and_a_fifth(
    make_drive_bench: Make, parameters: dict[str, float], most_mm: float
) -> None:
    bench = make_drive_bench(**parameters)
    bench.insertion.objects |= {
        (0x608F, 1): (20_000).to_bytes(4, "little"),
        (0x608F, 2): (1).to_bytes(4, "little"),
    }
    searches(bench.insertion, itertools.repeat(-3 * MM_S))
    homing(bench)
    until_fault(bench)
    assert bench.notices[-1].rule is Rule.HOMING_TIME
    assert f"without finding its home, at most {most_mm:.4g} mm" in bench.status.fault
    # One cycle to see it, one that was under way.
    assert most_mm < abs(bench.insertion.position) / 2e4 <= most_mm + 2 * 0.06
    at = bench.positions
    bench.cycle(10)
    assert bench.positions == at


@pytest.mark.parametrize("method", [17, 18])
@pytest.mark.parametrize("reverse", [False, True])
def test_homing_time_a_drive_that_goes_away_from_its_switch_is_stopped(
    make_drive_bench: Make, method: int, reverse: bool
) -> None:
    bench = make_drive_bench(insertion_homing_method=method, insertion_reverse=reverse)
    away = 1 if method == 17 else -1
    searches(bench.insertion, itertools.repeat(away * 2 * MM_S))
    homing(bench)
    until_fault(bench)
    assert bench.notices[-1].rule is Rule.HOMING_TIME
    assert f"away from the limit switch of homing method {method}" in bench.status.fault
    assert abs(bench.insertion.position) <= 10_000 + 4 * MM_S, "0.5 mm and two cycles"


@pytest.mark.parametrize(("method", "switch"), [(17, 1), (18, 2)])
def test_homing_time_off_its_switch_a_drive_goes_the_other_way(
    make_drive_bench: Make, method: int, switch: int
) -> None:
    bench = make_drive_bench(insertion_homing_method=method)
    bench.insertion.inputs = switch
    away = 1 if method == 17 else -1
    searches(bench.insertion, itertools.repeat(away * MM_S // 2))
    homing(bench)
    bench.cycle(50)
    bench.insertion.inputs = 0
    bench.cycle(150)
    assert abs(bench.insertion.position) > 30_000
    assert in_state(bench, State.MOVING), bench.status.fault


def test_homing_time_the_direction_is_not_judged_where_a_drive_tells_no_switches(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.insertion.missing_objects, bench.insertion.status_size = {0x60FD}, 3
    searches(bench.insertion, itertools.repeat(MM_S // 2))
    homing(bench)
    bench.cycle(150)
    assert in_state(bench, State.MOVING), bench.status.fault


def test_homing_time_a_drive_that_reports_a_failure_has_no_other_name(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    searches(bench.insertion, itertools.repeat(0))
    homing(bench)
    bench.cycle(6)
    bench.insertion.more_status = 0x2000
    bench.cycle(1)
    assert bench.notices[-1].rule is Rule.ONE_FAULT_STOPS_BOTH
    assert bench.status.fault == "insertion axis: the drive reports that homing failed"
