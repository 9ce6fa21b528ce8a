"""The transition table, transition by transition."""

from __future__ import annotations

import pytest

from needle_device_driver.supervisor.states import (
    TRANSITIONS,
    ForbiddenTransitionError,
    State,
    Trigger,
    next_state,
)

WAYS = {
    "UNCONFIGURED configure DISABLED",
    "DISABLED deconfigure UNCONFIGURED",
    "DISABLED enable HOLDING",
    "HOLDING disable DISABLED",
    "MOVING disable DISABLED",
    "HOLDING motion start MOVING",
    "MOVING motion end HOLDING",
    "DISABLED homing start MOVING",
    "MOVING homing end DISABLED",
    "UNCONFIGURED fail FAULT",
    "DISABLED fail FAULT",
    "HOLDING fail FAULT",
    "MOVING fail FAULT",
    "UNCONFIGURED estop ESTOPPED",
    "DISABLED estop ESTOPPED",
    "HOLDING estop ESTOPPED",
    "MOVING estop ESTOPPED",
    "FAULT estop ESTOPPED",
    "FAULT reset DISABLED",
    "ESTOPPED reset DISABLED",
    "FAULT reset before configuration UNCONFIGURED",
    "ESTOPPED reset before configuration UNCONFIGURED",
}


def test_each_pair_leads_where_it_should_or_nowhere() -> None:
    found = {f"{a.value} {trigger.value} {b.value}" for (a, trigger), b in TRANSITIONS.items()}
    assert found == WAYS
    assert next_state(State.HOLDING, Trigger.MOTION_START) is State.MOVING
    with pytest.raises(ForbiddenTransitionError, match="no transition from FAULT by motion start"):
        next_state(State.FAULT, Trigger.MOTION_START)
