"""The transition table, transition by transition."""

from __future__ import annotations

import itertools

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


@pytest.mark.parametrize(("state", "trigger"), list(itertools.product(State, Trigger)))
def test_each_pair_leads_where_it_should_or_nowhere(state: State, trigger: Trigger) -> None:
    wanted = [way for way in WAYS if way.startswith(f"{state.value} {trigger.value} ")]
    wanted = [way for way in wanted if way.rsplit(" ", 1)[0] == f"{state.value} {trigger.value}"]
    if wanted:
        assert next_state(state, trigger).value == wanted[0].rsplit(" ", 1)[1]
    else:
        with pytest.raises(ForbiddenTransitionError, match=trigger.value):
            next_state(state, trigger)


def test_motion_starts_only_where_it_may_and_a_reset_ends_where_nothing_moves() -> None:
    into_moving = {key for key, state in TRANSITIONS.items() if state is State.MOVING}
    assert into_moving == {
        (State.HOLDING, Trigger.MOTION_START),
        (State.DISABLED, Trigger.HOMING_START),
    }
    after_reset = {state for (_, t), state in TRANSITIONS.items() if t is Trigger.RESET}
    assert after_reset == {State.DISABLED}
