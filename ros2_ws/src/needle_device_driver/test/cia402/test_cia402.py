"""State machine of a drive: statuswords, transitions, commands to each goal."""

from __future__ import annotations

import itertools

from needle_device_driver.cia402.cia402 import (
    FAULTS,
    TRANSITIONS,
    DriveCommand,
    DriveState,
    Goal,
    TransitionMonitor,
    drive_state,
    next_command,
)

# CiA 402-2: bits 6, 5 and 3..0 of the statusword; x: any value.
PATTERNS = {
    "x0xx 0000": "NOT_READY_TO_SWITCH_ON",
    "x1xx 0000": "SWITCH_ON_DISABLED",
    "x01x 0001": "READY_TO_SWITCH_ON",
    "x01x 0011": "SWITCHED_ON",
    "x01x 0111": "OPERATION_ENABLED",
    "x00x 0111": "QUICK_STOP_ACTIVE",
    "x0xx 1111": "FAULT_REACTION_ACTIVE",
    "x0xx 1000": "FAULT",
}
# Transitions by controlword, with the standard's numbers.
WAYS = {
    (2,): "SWITCH_ON_DISABLED SHUTDOWN READY_TO_SWITCH_ON",
    (3,): "READY_TO_SWITCH_ON SWITCH_ON SWITCHED_ON",
    (4,): "SWITCHED_ON ENABLE_OPERATION OPERATION_ENABLED",
    (5,): "OPERATION_ENABLED SWITCH_ON SWITCHED_ON",
    (6, 8): "SWITCHED_ON|OPERATION_ENABLED SHUTDOWN READY_TO_SWITCH_ON",
    (7, 10): "READY_TO_SWITCH_ON|SWITCHED_ON DISABLE_VOLTAGE|QUICK_STOP SWITCH_ON_DISABLED",
    (9, 12): "OPERATION_ENABLED|QUICK_STOP_ACTIVE DISABLE_VOLTAGE SWITCH_ON_DISABLED",
    (11,): "OPERATION_ENABLED QUICK_STOP QUICK_STOP_ACTIVE",
    (15,): "FAULT FAULT_RESET SWITCH_ON_DISABLED",
    (16,): "QUICK_STOP_ACTIVE ENABLE_OPERATION OPERATION_ENABLED",
}


def fits(word: int, pattern: str) -> bool:
    bits = pattern.replace(" ", "")
    return all(bit in ("x", value) for bit, value in zip(bits, f"{word & 0xFF:08b}", strict=True))


def test_states_and_transitions_match_the_standard() -> None:
    for word in range(256):
        # The upper byte and bits 4 and 7 do not encode the state.
        wanted = [name for pattern, name in PATTERNS.items() if fits(word, pattern)]
        found = drive_state(word | 0x1600)
        assert ([found.name] if found else []) == wanted
    ways = [[part.split("|") for part in way.split()] for way in WAYS.values()]
    wanted_ways = {one for way in ways for one in itertools.product(*way)}
    assert {(a.name, c.name, b.name) for (a, c), b in TRANSITIONS.items()} == wanted_ways


def test_commands_reach_every_goal_without_fault_reset() -> None:
    ends = {
        Goal.ON: {DriveState.OPERATION_ENABLED},
        Goal.OFF: {DriveState.SWITCH_ON_DISABLED},
        Goal.STOPPED: {DriveState.QUICK_STOP_ACTIVE, DriveState.SWITCH_ON_DISABLED},
    }
    # A drive leaves the first state by itself (transition 1).
    ways = [s for s in DriveState if s not in (*FAULTS, DriveState.NOT_READY_TO_SWITCH_ON)]
    for start, (goal, wanted) in itertools.product(ways, ends.items()):
        at: DriveState = start
        for _ in range(5):
            at = TRANSITIONS.get((at, next_command(goal, at, at_rest=True)), at)
        assert at in wanted, (start, goal)
    for state, goal in itertools.product([*FAULTS, DriveState.NOT_READY_TO_SWITCH_ON], Goal):
        order = DriveCommand.QUICK_STOP if goal is Goal.STOPPED else DriveCommand.DISABLE_VOLTAGE
        assert next_command(goal, state, at_rest=True) is order


def test_moving_axis_never_coasts() -> None:
    for goal in (Goal.OFF, Goal.STOPPED):
        for state in (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE):
            assert next_command(goal, state, at_rest=False) is DriveCommand.QUICK_STOP
    on = next_command(Goal.ON, DriveState.QUICK_STOP_ACTIVE, at_rest=False)
    assert on is DriveCommand.QUICK_STOP
    # An unknown state disables.
    assert next_command(Goal.ON, None, at_rest=True) is DriveCommand.DISABLE_VOLTAGE
    assert next_command(Goal.STOPPED, None, at_rest=True) is DriveCommand.QUICK_STOP


def test_transition_monitor_reports_unexplained_transitions() -> None:
    watch = TransitionMonitor()
    for state, command in (
        (DriveState.NOT_READY_TO_SWITCH_ON, DriveCommand.DISABLE_VOLTAGE),
        (DriveState.SWITCH_ON_DISABLED, DriveCommand.SHUTDOWN),
        (DriveState.SWITCH_ON_DISABLED, DriveCommand.SHUTDOWN),
        (DriveState.READY_TO_SWITCH_ON, DriveCommand.SWITCH_ON),
        (DriveState.SWITCHED_ON, DriveCommand.ENABLE_OPERATION),
        (DriveState.SWITCHED_ON, DriveCommand.QUICK_STOP),
        (DriveState.OPERATION_ENABLED, DriveCommand.QUICK_STOP),
        *[(DriveState.QUICK_STOP_ACTIVE, DriveCommand.ENABLE_OPERATION)] * 6,
    ):
        assert watch.unexplained(state) == ""
        watch.note_command(command)
    by_itself = watch.unexplained(DriveState.SWITCH_ON_DISABLED)
    assert by_itself == "changed from QUICK_STOP_ACTIVE to SWITCH_ON_DISABLED without a command"
    # Its faults, and the power after them, are reported by other means.
    for state in (DriveState.FAULT_REACTION_ACTIVE, DriveState.FAULT, DriveState.OPERATION_ENABLED):
        assert watch.unexplained(state) == ""
