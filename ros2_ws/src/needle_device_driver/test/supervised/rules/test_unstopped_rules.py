"""Drives that ignore a stop, named as in docs/safety.md: said while it lasts, and switched off."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.states import State

from ..checks import in_state
from ..drive_bench import DriveBench
from ..scripted_drives import ScriptedDrive

Make = Callable[..., DriveBench]


def runs_on(drive: ScriptedDrive, *states: str, way: int = 400) -> None:
    """Let a motor go on at 1 mm/s while its drive says that it is in one of these states."""
    sync = drive.sync

    def moving() -> None:
        sync()
        if drive.state in states:
            drive.position += way
            drive.demand = drive.position

    drive.sync = moving  # type: ignore[method-assign]


def ignores(drive: ScriptedDrive, *, quick_stop: bool, off: bool) -> None:
    """Let a drive ignore the orders to stop, or to switch off."""
    command = drive.command

    def deaf(word: int) -> None:
        stops, switches_off = word & 0x06 == 0x02, not word & 0x02
        if not ((quick_stop and stops) or (off and switches_off)):
            command(word)

    drive.command = deaf  # type: ignore[method-assign]


def estop(bench: DriveBench) -> None:
    bench.supervisor.receive_estop(True)
    assert in_state(bench, State.ESTOPPED)
    assert bench.status.fault == "emergency stop"


def told(bench: DriveBench) -> list[str]:
    return [str(notice) for notice in bench.notices if notice.rule is Rule.QUICK_STOP]


def test_estop_latches_and_says_nothing_of_drives_that_stop(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    estop(bench)
    for _ in range(120):
        bench.cycle(1)
        assert bench.status.fault == "emergency stop"
    assert told(bench) == []
    # Once it is off, a hand may move it.
    for _ in range(20):
        bench.insertion.position += 800
        bench.cycle(1)
        assert bench.status.fault == "emergency stop"


def test_quick_stop_that_a_drive_only_says_after_an_emergency_stop_switches_it_off(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.moving()
    runs_on(bench.insertion, "quick stop")
    at = bench.insertion.position
    estop(bench)
    bench.cycle(20)
    assert bench.insertion.state == "disabled"
    assert bench.insertion.position - at <= 4_400, "0.2 mm: 0.2 s of them"
    assert told(bench) == ["insertion axis still moving [quick_stop]"]
    assert bench.notices[-1].fault
    bench.cycle(10)
    assert bench.status.fault == "emergency stop", "it stands"


def test_quick_stop_that_a_drive_ignores_after_an_emergency_stop_is_told_and_switches_it_off(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.moving()
    ignores(bench.insertion, quick_stop=True, off=False)
    runs_on(bench.insertion, "enabled")
    estop(bench)
    bench.cycle(12)
    assert bench.status.fault == "emergency stop; insertion axis still moving"
    # Some drives take half a second to begin.
    bench.cycle(30)
    assert bench.insertion.state == "disabled"
    bench.cycle(10)
    assert bench.status.fault == "emergency stop"


def test_quick_stop_that_a_homing_drive_ignores_after_an_emergency_stop(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.configured()
    drive = bench.insertion
    drive.home_after = 10**9
    ignores(drive, quick_stop=True, off=True)
    runs_on(drive, "enabled", way=-400)
    bench.supervisor.confirm_needle_out(True)
    assert bench.run(bench.supervisor.home(bench.clock())).success
    bench.cycle(15)
    at = drive.position
    assert at < 0
    estop(bench)
    bench.cycle(60)
    assert bench.status.fault == "emergency stop; insertion axis still powered and moving"
    assert drive.position < at


@pytest.mark.parametrize("axis", ["insertion", "rotation"])
def test_quick_stop_a_drive_that_stands_and_keeps_its_power_is_told_until_it_is_off(
    drive_bench: DriveBench, axis: str
) -> None:
    bench = drive_bench
    bench.moving()
    drive = getattr(bench, axis)
    ignores(drive, quick_stop=False, off=True)
    estop(bench)
    bench.cycle(49)
    assert bench.status.fault == "emergency stop"
    bench.cycle(5)
    assert bench.status.fault == f"emergency stop; {axis} axis still powered"
    assert told(bench) == [f"{axis} axis still powered [quick_stop]"]
    drive.state = "disabled"
    bench.cycle(2)
    assert bench.status.fault == "emergency stop"


def test_quick_stop_a_drive_that_takes_neither_order_is_told_to_switch_off(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.moving()
    ignores(bench.insertion, quick_stop=True, off=False)
    estop(bench)
    bench.cycle(105)
    assert bench.insertion.state == "disabled"
    assert told(bench) == ["insertion axis still powered [quick_stop]"]


def test_quick_stop_a_motor_that_runs_on_though_its_drive_says_that_it_is_off(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.moving()
    runs_on(bench.insertion, "quick stop", "disabled")
    estop(bench)
    bench.cycle(60)
    assert bench.status.fault == "emergency stop; insertion axis still moving"


def test_quick_stop_a_drive_that_falls_silent_after_an_emergency_stop_is_told(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.moving()
    estop(bench)
    bench.rotation.silent = True
    bench.cycle(8)
    assert bench.status.fault == "emergency stop; rotation axis silent"
    bench.rotation.silent = False
    bench.cycle(4)
    assert bench.status.fault == "emergency stop"


def test_quick_stop_a_drive_that_ignores_the_stop_of_a_fault_is_told_too(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.moving()
    runs_on(bench.insertion, "quick stop", "disabled")
    bench.rotation.fail(0x2310)
    bench.bus.flush()
    bench.cycle(60)
    assert in_state(bench, State.FAULT)
    assert bench.status.fault == (
        "rotation axis: the drive reports 0x2310 continuous over-current; "
        "insertion axis still moving"
    )


def test_quick_stop_after_a_reset_nothing_of_it_is_left(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    ignores(bench.insertion, quick_stop=False, off=True)
    estop(bench)
    bench.cycle(60)
    assert "still powered" in bench.status.fault
    bench.insertion.state = "disabled"
    bench.supervisor.receive_estop(False)
    bench.hold(False)
    assert bench.run(bench.supervisor.reset(bench.clock())).success
    assert bench.status.fault == ""
    bench.cycle(2)
    assert bench.status.fault == ""


def test_quick_stop_a_disabled_drive_that_runs_on_is_a_fault(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    runs_on(bench.insertion, "quick stop")
    assert bench.supervisor.enable(False, bench.clock()).success
    bench.cycle(20)
    assert in_state(bench, State.FAULT)
    assert "runs on in its quick stop" in bench.status.fault
    assert bench.insertion.state == "disabled"
