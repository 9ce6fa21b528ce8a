"""The way of one drive to its goal, fed with statuswords by hand."""

from __future__ import annotations

import itertools

import pytest

from needle_device_driver.cia402.cia402 import DriveCommand, Goal, Mode
from needle_device_driver.cia402.drive_machine import DriveMachine
from needle_device_driver.cia402.drive_monitor import Feedback

DISABLED, READY, ON, ENABLED, QUICK_STOP, FAULT = 0x0250, 0x0231, 0x0233, 0x0237, 0x0217, 0x0218
NUMBERS = itertools.count(1)


def said(statusword: int, position: int = 0, mode: int = 8, behind: int = 0) -> Feedback:
    return Feedback(next(NUMBERS), statusword, mode, 0, position, behind)


@pytest.fixture
def machine() -> DriveMachine:
    return DriveMachine(rest_counts=2, period=0.02, stop_time=0.05, at=said(DISABLED))


def enabled(machine: DriveMachine) -> None:
    machine.want(Goal.ON)
    for statusword in (DISABLED, READY, ON, ENABLED):
        machine.next_order()
        machine.update(said(statusword))
    assert machine.ready


def test_switching_on_takes_a_step_for_each_statusword(machine: DriveMachine) -> None:
    machine.want(Goal.ON)
    orders = []
    for statusword in (DISABLED, DISABLED, READY, ON, ENABLED):
        machine.update(said(statusword))
        orders.append(machine.next_order()[0])
    assert orders == [
        DriveCommand.SHUTDOWN,
        DriveCommand.SHUTDOWN,
        DriveCommand.SWITCH_ON,
        DriveCommand.ENABLE_OPERATION,
        DriveCommand.ENABLE_OPERATION,
    ]
    assert machine.ready
    assert not machine.switching


def test_until_it_is_ready_the_set_point_is_where_the_axis_stands(machine: DriveMachine) -> None:
    machine.want(Goal.ON)
    for position, statusword in ((5, DISABLED), (70, READY), (900, ON)):
        machine.update(said(statusword, position))
        assert machine.target == position
    machine.update(said(ENABLED, 901))
    assert machine.target == 900


@pytest.mark.parametrize("goal", [Goal.OFF, Goal.ON])
def test_after_a_quick_stop_nothing_is_ordered_before_the_axis_stands(
    machine: DriveMachine, goal: Goal
) -> None:
    enabled(machine)
    machine.stop()
    machine.want(goal)
    position = 0
    for speed in (400, 300, 200, 100, 3):
        position += speed
        machine.update(said(QUICK_STOP, position))
        assert machine.next_order()[0] is DriveCommand.QUICK_STOP
        assert not machine.ready
    for _ in range(3):
        # It trembles by two counts.
        position += 2
        assert machine.next_order()[0] is DriveCommand.QUICK_STOP
        machine.update(said(QUICK_STOP, position))
    wanted = {Goal.OFF: DriveCommand.DISABLE_VOLTAGE, Goal.ON: DriveCommand.ENABLE_OPERATION}
    assert machine.next_order()[0] is wanted[goal]
    assert machine.target == position


def test_a_stop_holds_until_the_drive_has_said_that_it_took_it(machine: DriveMachine) -> None:
    enabled(machine)
    machine.stop()
    machine.want(Goal.ON)
    for _ in range(5):
        assert machine.next_order()[0] is DriveCommand.QUICK_STOP
        machine.update(said(ENABLED))
        assert not machine.ready


@pytest.mark.parametrize("behind", [3, -3])
def test_a_stopped_axis_that_its_drive_would_pull_on_is_switched_off(
    machine: DriveMachine, behind: int
) -> None:
    enabled(machine)
    machine.stop()
    machine.next_order()
    for position in (400, 500, 500, 500, 500):
        assert not machine.let_go
        machine.update(said(QUICK_STOP, position, behind=2))
        assert machine.next_order()[0] is DriveCommand.QUICK_STOP
    machine.update(said(QUICK_STOP, 500, behind=behind))
    assert machine.let_go
    assert machine.powered, "it is stopped, it has not lost its power"
    assert machine.next_order()[0] is DriveCommand.DISABLE_VOLTAGE
    machine.update(said(DISABLED, 500))
    assert machine.next_order()[0] is DriveCommand.DISABLE_VOLTAGE
    assert machine.trouble == ""
    machine.want(Goal.ON)
    for statusword in (DISABLED, READY, ON, ENABLED):
        machine.next_order()
        machine.update(said(statusword, 500))
    assert machine.ready
    assert not machine.let_go


@pytest.mark.parametrize(
    ("ways", "off"),
    [
        # It runs on; it slows down too late; it creeps at the edge of what counts as rest.
        ([100] * 20, True),
        ([100] * 9 + [80, 60, 40, 20, 0, 0, 0, 0, 0, 0, 0], True),
        ([2] * 20, False),
        # It stops on its ramp; it trembles by more than it may at rest.
        ([100, 60, 20] + [0] * 17, False),
        ([8, -8] * 10, False),
    ],
)
def test_a_drive_that_runs_on_in_its_quick_stop_is_switched_off(
    machine: DriveMachine, ways: list[int], off: bool
) -> None:
    enabled(machine)
    machine.stop()
    orders = [machine.next_order()[0]]
    for position in itertools.accumulate(ways):
        machine.update(said(QUICK_STOP, position))
        orders.append(machine.next_order()[0])
    # 50 ms of ramp are 3 cycles, 2 more for late answers, and 5 to see where it goes.
    assert orders[:10] == [DriveCommand.QUICK_STOP] * 10
    assert orders[10:] == [DriveCommand.DISABLE_VOLTAGE if off else DriveCommand.QUICK_STOP] * 11
    assert ("runs on in its quick stop" in machine.trouble) is off


def test_a_stop_after_one_that_ran_on_is_a_new_one(machine: DriveMachine) -> None:
    for _ in range(2):
        enabled(machine)
        machine.stop()
        for position in range(0, 2000, 100):
            machine.next_order()
            machine.update(said(QUICK_STOP, position))
        assert machine.next_order()[0] is DriveCommand.DISABLE_VOLTAGE
        assert "runs on" in machine.trouble
        machine.begin_anew(said(DISABLED, 2000))


def test_the_mode_changes_only_while_the_drive_is_off(machine: DriveMachine) -> None:
    enabled(machine)
    machine.mode = Mode.HOMING
    assert machine.next_order() == (
        DriveCommand.QUICK_STOP,
        Mode.CYCLIC_SYNCHRONOUS_POSITION,
    )
    for _ in range(4):
        machine.update(said(QUICK_STOP))
    assert machine.next_order() == (
        DriveCommand.DISABLE_VOLTAGE,
        Mode.CYCLIC_SYNCHRONOUS_POSITION,
    )
    machine.update(said(DISABLED))
    assert machine.next_order() == (DriveCommand.SHUTDOWN, Mode.HOMING)
    machine.update(said(ON))
    # Not enabled before the drive shows the mode.
    assert machine.next_order()[0] is DriveCommand.SWITCH_ON
    machine.update(said(ON, mode=6))
    assert machine.next_order()[0] is DriveCommand.ENABLE_OPERATION


def test_an_axis_that_never_comes_to_rest_is_switched_off_all_the_same(
    machine: DriveMachine,
) -> None:
    enabled(machine)
    machine.want(Goal.OFF)
    for count in range(60):
        machine.update(said(QUICK_STOP, 1000 * count))
    assert machine.next_order()[0] is DriveCommand.DISABLE_VOLTAGE


def test_a_fault_is_left_alone_and_a_word_of_no_state_is_trouble(machine: DriveMachine) -> None:
    enabled(machine)
    machine.update(said(FAULT))
    assert machine.next_order()[0] is DriveCommand.DISABLE_VOLTAGE
    assert machine.trouble == ""
    machine.update(said(0x0025))
    assert "0x0025" in machine.trouble
    machine.begin_anew(said(DISABLED))
    assert machine.trouble == ""
    assert machine._goal is Goal.OFF


@pytest.mark.parametrize(("statusword", "told"), [(0x0250, False), (0x0050, True)])
def test_a_drive_that_does_not_listen_to_the_bus_is_told(
    machine: DriveMachine, statusword: int, told: bool
) -> None:
    machine.want(Goal.ON)
    for _ in range(102):
        machine.update(said(statusword))
    assert "is not on after 2 s: SWITCH_ON_DISABLED, mode 8" in machine.trouble
    assert ("not under the bus's control (bit 9)" in machine.trouble) is told
