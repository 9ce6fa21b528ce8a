"""State machine of one drive, with scripted statuswords."""

from __future__ import annotations

import itertools

import pytest

from needle_device_driver.cia402.cia402 import DriveCommand, Goal, Mode
from needle_device_driver.cia402.drive_machine import DriveMachine
from needle_device_driver.cia402.drive_monitor import Feedback

DISABLED, READY, ON, ENABLED, QUICK_STOP, FAULT = 0x0250, 0x0231, 0x0233, 0x0237, 0x0217, 0x0218
NUMBERS = itertools.count(1)


def state(statusword: int, position: int = 0, behind: int = 0, mode: int = 8) -> Feedback:
    return Feedback(next(NUMBERS), statusword, mode, 0, position, behind)


@pytest.fixture
def machine() -> DriveMachine:
    return DriveMachine(rest_counts=2, period=0.02, stop_time=0.05, at=state(DISABLED))


def orders(machine: DriveMachine, *answers: Feedback) -> list[DriveCommand]:
    """Return the command after each answer."""
    machine.next_order()
    given = []
    for answer in answers:
        machine.update(answer)
        given.append(machine.next_order()[0])
    return given


def enabled(machine: DriveMachine, position: int = 0) -> None:
    machine.set_goal(Goal.ON)
    assert machine.switching
    orders(machine, *(state(word, position) for word in (DISABLED, READY, ON, ENABLED)))
    assert machine.ready
    assert not machine.switching


@pytest.mark.parametrize("goal", [Goal.OFF, Goal.ON])
def test_no_command_after_a_quick_stop_before_the_axis_rests(
    machine: DriveMachine, goal: Goal
) -> None:
    enabled(machine)
    machine.stop()
    machine.set_goal(goal)
    # Jitter of two counts in the last three cycles.
    ways = [*itertools.accumulate((400, 300, 200, 100, 3, 2, 2))]
    given = orders(machine, *(state(QUICK_STOP, position) for position in ways))
    assert given == [DriveCommand.QUICK_STOP] * 7
    wanted = {Goal.OFF: DriveCommand.DISABLE_VOLTAGE, Goal.ON: DriveCommand.ENABLE_OPERATION}
    assert orders(machine, state(QUICK_STOP, 1009)) == [wanted[goal]]
    assert machine.target == 1009


def test_drive_that_stays_in_its_quick_stop_is_switched_off_and_on(machine: DriveMachine) -> None:
    """Transition 16 is optional."""
    enabled(machine)
    machine.stop()
    machine.set_goal(Goal.ON)
    orders(machine, *(state(QUICK_STOP, 100 * count) for count in range(20)))
    assert orders(machine, *[state(QUICK_STOP, 1900)] * 12) == [
        *[DriveCommand.QUICK_STOP] * 2,
        *[DriveCommand.ENABLE_OPERATION] * 8,
        *[DriveCommand.DISABLE_VOLTAGE] * 2,
    ]


@pytest.mark.parametrize("behind", [3, -3])
def test_blocked_axis_is_released_when_stopped(machine: DriveMachine, behind: int) -> None:
    enabled(machine)
    machine.stop()
    places = (400, 500, 500, 500, 500)
    # A moving axis lags behind; at rest, two counts are within the limit.
    lags = (*[100 * behind] * 4, behind // 3 * 2)
    given = orders(machine, *(state(QUICK_STOP, *at) for at in zip(places, lags, strict=True)))
    assert (given, machine.released_after_block) == ([DriveCommand.QUICK_STOP] * 5, False)
    assert orders(machine, state(QUICK_STOP, 500, behind=behind)) == [DriveCommand.DISABLE_VOLTAGE]
    assert machine.released_after_block
    assert machine.powered, "it is stopped, it has not lost its power"
    assert orders(machine, state(DISABLED, 500)) == [DriveCommand.DISABLE_VOLTAGE]
    enabled(machine, 500)
    assert not machine.released_after_block


@pytest.mark.parametrize(
    ("ways", "off"),
    [
        # The drive keeps moving; brakes too late; creeps at the limit of rest.
        ([100] * 20, True),
        ([100] * 9 + [80, 60, 40, 20, 0, 0, 0, 0, 0, 0, 0], True),
        ([2] * 20, False),
        # The drive jitters by more than the limit of rest.
        ([8, -8] * 10, False),
    ],
)
def test_drive_that_moves_on_in_its_quick_stop_is_switched_off(
    machine: DriveMachine, ways: list[int], off: bool
) -> None:
    enabled(machine)
    machine.stop()
    given = orders(machine, *(state(QUICK_STOP, at) for at in itertools.accumulate(ways)))
    # 3 cycles for a ramp of 50 ms, 2 for late answers, 5 to observe the motion.
    late = DriveCommand.DISABLE_VOLTAGE if off else DriveCommand.QUICK_STOP
    assert given == [DriveCommand.QUICK_STOP] * 9 + [late] * 11
    text = f"keeps moving in its quick stop ({sum(ways[5:10])} counts in 0.1 s) and is switched off"
    assert machine.problem.startswith(text) if off else machine.problem == ""


def test_the_mode_changes_only_while_the_drive_is_off(machine: DriveMachine) -> None:
    enabled(machine)
    machine.mode = Mode.HOMING
    position = Mode.CYCLIC_SYNCHRONOUS_POSITION
    # The axis has been at rest since it was enabled.
    assert machine.next_order() == (DriveCommand.QUICK_STOP, position)
    for answer, order in (
        (state(QUICK_STOP), (DriveCommand.DISABLE_VOLTAGE, position)),
        (state(DISABLED), (DriveCommand.SHUTDOWN, Mode.HOMING)),
        # Not enabled before the drive shows the mode.
        (state(ON), (DriveCommand.SWITCH_ON, Mode.HOMING)),
        (state(ON, mode=6), (DriveCommand.ENABLE_OPERATION, Mode.HOMING)),
    ):
        machine.update(answer)
        assert machine.next_order() == order
        assert not machine.powered
    machine.update(state(ENABLED, mode=6))
    assert (machine.powered, machine.ready) == (True, False)


def test_axis_that_never_rests_is_switched_off(machine: DriveMachine) -> None:
    enabled(machine)
    machine.set_goal(Goal.OFF)
    # Jitter does not count as motion.
    given = orders(machine, *(state(QUICK_STOP, 8 + 8 * (count % 2)) for count in range(51)))
    assert given == [DriveCommand.QUICK_STOP] * 50 + [DriveCommand.DISABLE_VOLTAGE]


def test_drive_that_ignores_the_stop_is_switched_off(machine: DriveMachine) -> None:
    enabled(machine)
    machine.stop()
    given = orders(machine, *(state(ENABLED, 100 * count) for count in range(35)))
    assert given == [DriveCommand.QUICK_STOP] * 34 + [DriveCommand.DISABLE_VOLTAGE]
    assert "keeps moving when stopped" in machine.problem


def test_fault_is_not_acknowledged_and_unknown_statusword_is_a_problem(
    machine: DriveMachine,
) -> None:
    enabled(machine)
    assert orders(machine, state(FAULT)) == [DriveCommand.DISABLE_VOLTAGE]
    assert machine.problem == ""
    machine.update(state(0x0025))
    assert machine.problem == "reports 0x0025, not a CiA 402 statusword"
    machine.restart(state(DISABLED, 7))
    assert (machine.problem, machine.target, machine.switching) == ("", 7, False)


def test_drive_that_is_not_on_after_two_seconds_is_reported(machine: DriveMachine) -> None:
    for statusword, remote in ((0x0240, ""), (0xFDD0, ", not under remote control (bit 9)")):
        machine.restart(state(DISABLED))
        machine.set_goal(Goal.ON)
        orders(machine, *[state(statusword, mode=6)] * 100)
        assert machine.problem == ""
        machine.update(state(statusword, mode=6))
        assert machine.problem == f"is not on after 2 s: SWITCH_ON_DISABLED, mode 6{remote}"
