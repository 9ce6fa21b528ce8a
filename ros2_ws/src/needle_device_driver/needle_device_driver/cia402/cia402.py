"""State machine of a CiA 402 drive."""

from __future__ import annotations

import enum
from collections import deque


class DriveState(enum.Enum):
    """States of a drive: mask and value of the statusword."""

    NOT_READY_TO_SWITCH_ON = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION_ACTIVE = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)


class DriveCommand(enum.IntEnum):
    """Commands: values of the controlword."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80


class Mode(enum.IntEnum):
    """Modes of operation in use."""

    HOMING = 6
    CYCLIC_SYNCHRONOUS_POSITION = 8


class Goal(enum.Enum):
    """Goals of the driver for a drive."""

    OFF = "off"
    ON = "on"
    STOPPED = "stopped"


# Bit of the controlword that begins a homing. Bits of the statusword: whether the drive executes
# the controlword, then bits whose meaning depends on the mode.
START_HOMING = 1 << 4
REMOTE = 1 << 9
TARGET_REACHED = 1 << 10
HOMING_ATTAINED = 1 << 12
FOLLOWING_ERROR = 1 << 13
HOMING_ERROR = 1 << 13
# 0x6502: supported modes.
SUPPORTS_HOMING = 1 << 5
SUPPORTS_CYCLIC_POSITION = 1 << 7

FAULTS = frozenset({DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE})
POWERED = frozenset({DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE})

# Transitions that a controlword causes, with their numbers in CiA 402-2. A drive performs 0 and 1
# (start), 13 and 14 (fault) by itself.
_S, _C = DriveState, DriveCommand
TRANSITIONS: dict[tuple[DriveState, DriveCommand], DriveState] = {
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 2
    (_S.READY_TO_SWITCH_ON, _C.SWITCH_ON): _S.SWITCHED_ON,  # 3
    (_S.SWITCHED_ON, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 4
    (_S.OPERATION_ENABLED, _C.SWITCH_ON): _S.SWITCHED_ON,  # 5
    (_S.SWITCHED_ON, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 6
    (_S.READY_TO_SWITCH_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 7
    (_S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 7
    (_S.OPERATION_ENABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 8
    (_S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 9
    (_S.SWITCHED_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 10
    (_S.SWITCHED_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 10
    (_S.OPERATION_ENABLED, _C.QUICK_STOP): _S.QUICK_STOP_ACTIVE,  # 11
    (_S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 12
    (_S.FAULT, _C.FAULT_RESET): _S.SWITCH_ON_DISABLED,  # 15
    (_S.QUICK_STOP_ACTIVE, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 16
}

# Bits of the statusword that encode the state, and the states by their value.
_STATE_BITS = 0x6F
_STATES = {
    word: state
    for word in range(_STATE_BITS + 1)
    for state in DriveState
    if word & state.value[0] == state.value[1]
}

# Next command towards the goal ON. It never acknowledges a fault.
_ON = {
    DriveState.SWITCH_ON_DISABLED: DriveCommand.SHUTDOWN,
    DriveState.READY_TO_SWITCH_ON: DriveCommand.SWITCH_ON,
    DriveState.SWITCHED_ON: DriveCommand.ENABLE_OPERATION,
    DriveState.OPERATION_ENABLED: DriveCommand.ENABLE_OPERATION,
    DriveState.QUICK_STOP_ACTIVE: DriveCommand.ENABLE_OPERATION,
}


def drive_state(statusword: int) -> DriveState | None:
    """Return the state that a statusword encodes; None for a value outside the standard."""
    return _STATES.get(statusword & _STATE_BITS)


def next_command(goal: Goal, state: DriveState | None, *, at_rest: bool) -> DriveCommand:
    """Return the command that leads from a state towards a goal.

    Parameters
    ----------
    goal : Goal
        The goal.
    state : DriveState or None
        State of the drive; None: unknown.
    at_rest : bool
        Whether the axis stands still.

    Returns
    -------
    DriveCommand
        Always a quick stop for STOPPED: the statusword may be older than the last command.
    """
    if goal is Goal.STOPPED:
        return DriveCommand.QUICK_STOP
    if state is None:
        return DriveCommand.DISABLE_VOLTAGE
    if goal is Goal.ON:
        if state is DriveState.QUICK_STOP_ACTIVE and not at_rest:
            return DriveCommand.QUICK_STOP
        return _ON.get(state, DriveCommand.DISABLE_VOLTAGE)
    # Stop a moving axis before it is switched off, so that it does not coast.
    is_moving = state is DriveState.QUICK_STOP_ACTIVE and not at_rest
    stop_first = state is DriveState.OPERATION_ENABLED or is_moving
    return DriveCommand.QUICK_STOP if stop_first else DriveCommand.DISABLE_VOLTAGE


class TransitionMonitor:
    """Detects state changes that no command explains.

    Commands and statuswords cross on the bus, so the last six commands are considered in order.
    """

    def __init__(self) -> None:
        self._sent: deque[DriveCommand] = deque(maxlen=6)
        self._state: DriveState | None = None

    def note_command(self, command: DriveCommand) -> None:
        """Record a command that is sent."""
        self._sent.append(command)

    def unexplained(self, state: DriveState) -> str:
        """Describe a transition to `state` that the drive made by itself; empty: none.

        Faults are excluded because they are reported separately.
        """
        before, self._state = self._state, state
        if before is None or before is state or state in FAULTS or before in FAULTS:
            return ""
        if before is DriveState.NOT_READY_TO_SWITCH_ON:
            return ""
        reachable: set[DriveState] = {before}
        for command in self._sent:
            reachable |= {
                TRANSITIONS[s, command] for s in tuple(reachable) if (s, command) in TRANSITIONS
            }
        if state in reachable:
            return ""
        return f"changed from {before.name} to {state.name} without a command"
