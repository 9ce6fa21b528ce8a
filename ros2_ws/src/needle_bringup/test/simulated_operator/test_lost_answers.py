"""Services whose answers are lost or late."""

import pytest

from needle_bringup.simulated_operator.operator_sequence import (
    ASK_AGAIN,
    ENABLE,
    HOME,
    PREPARATION,
    START,
    ServiceCall,
)

from .sequences import DISABLED, outcome, reach, see, steering


@pytest.mark.parametrize("call", PREPARATION)
def test_a_call_whose_answer_was_lost_is_made_again(call: ServiceCall) -> None:
    sequence = reach(call)
    assert sequence.next_call(0.9 + ASK_AGAIN) is None
    assert sequence.next_call(1.0 + ASK_AGAIN) == call
    sequence.take_answer(call, True, "", 2.1)
    assert sequence.next_call(2.1) != call


@pytest.mark.parametrize("call", PREPARATION[:-1])
def test_a_late_answer_is_to_its_own_call_alone(call: ServiceCall) -> None:
    sequence = reach(call)
    assert sequence.next_call(1.0 + ASK_AGAIN) == call
    sequence.take_answer(call, True, "", 2.1)
    following = sequence.next_call(2.1)
    assert following == PREPARATION[PREPARATION.index(call) + 1]
    sequence.take_answer(call, True, "", 2.2)
    assert not sequence.steering
    assert sequence.next_call(2.2) is None, "that one has not been answered"
    sequence.take_answer(call, False, "the device is MOVING", 2.3)
    assert sequence.next_call(2.5) is None


def test_a_homing_whose_answer_was_lost_is_not_asked_for_again_while_it_moves() -> None:
    sequence = reach(HOME)
    see(sequence, {"homed": "true", "state": "MOVING"}, 1.2)
    assert sequence.next_call(5.0) is None
    see(sequence, DISABLED, 9.0)
    assert sequence.next_call(9.0) == ENABLE


def test_homed_from_before_the_call_is_no_answer_to_it() -> None:
    sequence = reach(HOME)
    # What was under way when the call was made.
    see(sequence, DISABLED | {"needle_out_confirmed": "true"}, 1.1)
    assert sequence.next_call(1.2) is None
    assert sequence.next_call(1.0 + ASK_AGAIN) == HOME


def test_a_start_whose_answer_was_lost_is_known_from_the_status() -> None:
    sequence = reach(START)
    sequence.see_controller(steering(starts="0", state="IDLE"), 1.1)
    assert not sequence.hold()
    sequence.see_controller(steering(), 1.2)
    assert sequence.hold()
    sequence.take_answer(START, False, "already steering", 1.3)
    assert outcome(sequence) is None
    assert sequence.next_call(9.0) is None
