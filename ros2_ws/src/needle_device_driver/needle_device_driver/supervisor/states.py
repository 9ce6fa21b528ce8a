"""States of the device and the transitions between them."""

from __future__ import annotations

import enum


class State(enum.Enum):
    """States of the device; only MOVING moves anything."""

    UNCONFIGURED = "UNCONFIGURED"
    DISABLED = "DISABLED"
    HOLDING = "HOLDING"
    MOVING = "MOVING"
    FAULT = "FAULT"
    ESTOPPED = "ESTOPPED"


class Trigger(enum.Enum):
    """Events that change the state."""

    CONFIGURE = "configure"
    ENABLE = "enable"
    DISABLE = "disable"
    MOTION_START = "motion start"
    MOTION_END = "motion end"
    HOMING_START = "homing start"
    HOMING_END = "homing end"
    FAIL = "fail"
    ESTOP = "estop"
    RESET = "reset"
    RESET_UNCONFIGURED = "reset before configuration"
    DECONFIGURE = "deconfigure"


class Activity(enum.Enum):
    """Kinds of motion in state MOVING."""

    NONE = "none"
    STEP = "step"
    RETRACTION = "retraction"
    HOMING = "homing"


TRANSITIONS: dict[tuple[State, Trigger], State] = {
    (State.UNCONFIGURED, Trigger.CONFIGURE): State.DISABLED,
    (State.DISABLED, Trigger.DECONFIGURE): State.UNCONFIGURED,
    (State.DISABLED, Trigger.ENABLE): State.HOLDING,
    (State.HOLDING, Trigger.DISABLE): State.DISABLED,
    (State.MOVING, Trigger.DISABLE): State.DISABLED,
    (State.HOLDING, Trigger.MOTION_START): State.MOVING,
    (State.MOVING, Trigger.MOTION_END): State.HOLDING,
    (State.DISABLED, Trigger.HOMING_START): State.MOVING,
    (State.MOVING, Trigger.HOMING_END): State.DISABLED,
    (State.UNCONFIGURED, Trigger.FAIL): State.FAULT,
    (State.DISABLED, Trigger.FAIL): State.FAULT,
    (State.HOLDING, Trigger.FAIL): State.FAULT,
    (State.MOVING, Trigger.FAIL): State.FAULT,
    (State.UNCONFIGURED, Trigger.ESTOP): State.ESTOPPED,
    (State.DISABLED, Trigger.ESTOP): State.ESTOPPED,
    (State.HOLDING, Trigger.ESTOP): State.ESTOPPED,
    (State.MOVING, Trigger.ESTOP): State.ESTOPPED,
    (State.FAULT, Trigger.ESTOP): State.ESTOPPED,
    (State.FAULT, Trigger.RESET): State.DISABLED,
    (State.ESTOPPED, Trigger.RESET): State.DISABLED,
    (State.FAULT, Trigger.RESET_UNCONFIGURED): State.UNCONFIGURED,
    (State.ESTOPPED, Trigger.RESET_UNCONFIGURED): State.UNCONFIGURED,
}


def next_state(state: State, trigger: Trigger) -> State:
    """Return the state after `trigger`; raises KeyError if the table has no such transition."""
    return TRANSITIONS[state, trigger]
