"""Transition table of the device."""

from __future__ import annotations

import pytest

from needle_device_driver.supervisor.states import (
    TRANSITIONS,
    ForbiddenTransitionError,
    State,
    Trigger,
    next_state,
)

# State before and after, by trigger.
PAIRS = {
    "configure": "UNCONFIGURED-DISABLED",
    "deconfigure": "DISABLED-UNCONFIGURED",
    "enable": "DISABLED-HOLDING",
    "disable": "HOLDING-DISABLED MOVING-DISABLED",
    "motion start": "HOLDING-MOVING",
    "motion end": "MOVING-HOLDING",
    "homing start": "DISABLED-MOVING",
    "homing end": "MOVING-DISABLED",
    "fail": "UNCONFIGURED-FAULT DISABLED-FAULT HOLDING-FAULT MOVING-FAULT",
    "estop": "UNCONFIGURED-ESTOPPED DISABLED-ESTOPPED HOLDING-ESTOPPED MOVING-ESTOPPED "
    "FAULT-ESTOPPED",
    "reset": "FAULT-DISABLED ESTOPPED-DISABLED",
    "reset before configuration": "FAULT-UNCONFIGURED ESTOPPED-UNCONFIGURED",
}


def test_transition_table() -> None:
    found = {f"{t.value}: {a.value}-{b.value}" for (a, t), b in TRANSITIONS.items()}
    assert found == {f"{t}: {pair}" for t, pairs in PAIRS.items() for pair in pairs.split()}
    assert next_state(State.HOLDING, Trigger.MOTION_START) is State.MOVING
    with pytest.raises(ForbiddenTransitionError, match="no transition from FAULT by motion start"):
        next_state(State.FAULT, Trigger.MOTION_START)
