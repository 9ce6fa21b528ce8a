"""The driver's rules about speed on emulated drives: units, homing, and no false alarm."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.states import State

from .driven_bench import DrivenBench

Make = Callable[..., DrivenBench]
RPM = {"rpm": True, "insertion_start": 0.1, "insertion_max_speed": 0.15}


@pytest.fixture
def make() -> Iterator[Make]:
    benches: list[DrivenBench] = []

    def made(*arguments: Any, **parameters: Any) -> DrivenBench:
        benches.append(DrivenBench(*arguments, **parameters))
        return benches[-1]

    yield made
    for bench in benches:
        bench.close()


def test_drives_that_take_speeds_in_rpm_and_say_so_home_at_the_speed_that_they_are_told(
    make: Make,
) -> None:
    bench = make({**RPM, "insertion_start": 0.01})
    start = bench.now
    bench.home()
    assert bench.cycles.missing_optional_objects == ()
    assert bench.status.homed
    # 10 mm at 2 mm/s and the way off the switch.
    assert 5.0 < bench.now - start < 5.6
    assert bench.insertion_mm == pytest.approx(0.0, abs=0.02)
    bench.enable()
    bench.wander(random.Random(1), 6)
    assert bench.supervisor.state in (State.HOLDING, State.MOVING), bench.status.fault
    assert bench.insertion_mm > 2.0


def test_drives_that_take_speeds_in_rpm_and_do_not_say_so_are_stopped_within_8_mm(
    make: Make,
) -> None:
    bench = make(RPM, tells_units=False)
    bench.home()
    assert len(bench.cycles.missing_optional_objects) == 2, "a warning for each drive"
    assert bench.supervisor.state is State.FAULT
    assert bench.notices[-1].rule is Rule.AXIS_SPEED
    assert "insertion axis: moves at 150 mm/s, at most 3.5 mm/s" in bench.status.fault
    bench.cycle(60)
    assert 100.0 - bench.insertion_mm < 8.0
    at = bench.insertion_mm
    bench.cycle(60)
    assert bench.insertion_mm == at
    assert bench.run(bench.supervisor.reset(bench.now)).success


def test_an_axis_of_10_mm_whose_switch_never_comes_runs_12_mm(make: Make) -> None:
    bench = make({"insertion_start": 0.2}, max_depth=0.01)
    bench.home()
    assert bench.supervisor.state is State.FAULT
    assert bench.notices[-1].rule is Rule.HOMING_TIME
    bench.cycle(20)
    assert 200.0 - bench.insertion_mm == pytest.approx(12.0, abs=0.15)


@pytest.mark.parametrize("start", [-0.003, -0.0001, 0.0, 0.00003, 0.01])
@pytest.mark.parametrize("rpm", [False, True])
def test_homing_from_anywhere_is_no_alarm(make: Make, start: float, rpm: bool) -> None:
    bench = make({"insertion_start": start, "rpm": rpm}, max_depth=0.01)
    bench.home()
    assert bench.status.homed, bench.status.fault
    assert bench.supervisor.state is State.DISABLED


def test_homing_to_the_positive_switch_of_an_axis_in_reverse_is_no_alarm(make: Make) -> None:
    bench = make({"insertion_start": 0.24}, insertion_reverse=True, insertion_homing_method=18)
    bench.home()
    assert bench.status.homed, bench.status.fault


def test_homing_on_a_machine_that_lets_the_driver_wait_is_no_alarm(make: Make) -> None:
    rng = random.Random(3)
    bench = make({"insertion_start": 0.02})
    bench.late = lambda: rng.choice((0.0, 0.0, 0.005, 0.015, 0.03, 0.05))
    bench.home()
    assert bench.status.homed, bench.status.fault


@pytest.mark.parametrize("lag", [0.0, 0.02, 0.09])
@pytest.mark.parametrize("late", [False, True])
def test_motions_that_are_broken_off_and_go_on_are_no_alarm(
    make: Make, lag: float, late: bool
) -> None:
    rng = random.Random(round(lag * 100) + late)
    bench = make({"insertion_lag": lag, "rotation_lag": min(lag, 0.02)})
    bench.home()
    bench.enable()
    if late:
        bench.late = lambda: rng.choice((0.0, 0.0, 0.004, 0.02, 0.04))
    bench.wander(rng, 15)
    assert bench.supervisor.state in (State.HOLDING, State.MOVING), bench.status.fault
    assert bench.insertion_mm > 3.0
    assert bench.supervisor.retract(bench.now).success or bench.supervisor.state is State.MOVING
    bench.cycle(100, hold=1.0)
    bench.supervisor.receive_estop(True)
    bench.cycle(60)
    assert bench.status.fault == "emergency stop"
