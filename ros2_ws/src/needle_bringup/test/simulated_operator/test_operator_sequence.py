"""Sequence of the simulated operator: calls, holds, failures, and when it must not act."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

from needle_bringup.simulated_operator.operator_sequence import (
    CALL_TIMEOUT,
    ENABLE,
    HOME,
    PREPARATION,
    START,
    OperatorSequence,
)
from needle_core.component import Call, Exit
from needle_core.status_messages import ControllerStatus, DeviceStatus

CONFIRM = PREPARATION[0]
DISABLED = DeviceStatus(homed=True, state="DISABLED", simulated=True)
HOLDING = dataclasses.replace(DISABLED, state="HOLDING")
MOVING = dataclasses.replace(DISABLED, state="MOVING")
FRESH = DeviceStatus(simulated=True)
STEERING = ControllerStatus(
    state="STEERING", step=3, insertion_m=0.003, depth_m=0.12, starts=1, reason=""
)


def on_device(sequence: OperatorSequence, status: DeviceStatus, now: float = 1.0) -> None:
    sequence.handle_device(dataclasses.replace(status, source="/sim_rig"), now)


def on_controller(sequence: OperatorSequence, now: float = 2.0, **changes: Any) -> None:
    sequence.handle_controller(dataclasses.replace(STEERING, **changes), now)


def without_status() -> OperatorSequence:
    """Return a sequence that has received no status and misses no partner."""
    sequence = OperatorSequence(0.0, "simulated_operator")
    sequence.handle_missing([])
    return sequence


def with_device() -> OperatorSequence:
    """Return a sequence with a single simulated device."""
    sequence = without_status()
    sequence.handle_devices(["/sim_rig"])
    on_device(sequence, FRESH, 0.0)
    on_controller(sequence, 0.0, state="IDLE", starts=0)
    return sequence


def outcome(sequence: OperatorSequence) -> Exit | None:
    """Return the outcome; a call, because mypy would narrow the attribute."""
    return sequence.outcome


def why(sequence: OperatorSequence) -> str:
    """Return the reason for which a run failed."""
    assert sequence.outcome is not None
    assert sequence.outcome.code != 0
    assert not sequence.hold()
    assert sequence.next_call(99.0) is None
    return sequence.outcome.text


def reach(wanted: Call | None = None, sequence: OperatorSequence | None = None) -> OperatorSequence:
    """Return a sequence just after its first attempt of a call, at 1.0 s; None: after all calls."""
    sequence = sequence or with_device()
    on_device(sequence, DISABLED)
    for call in PREPARATION:
        assert not sequence.hold()
        assert sequence.next_call(1.0) == call
        assert sequence.next_call(1.0) is None, "one call at a time"
        if call == wanted:
            return sequence
        sequence.handle_answer(call, True, "", 1.0)
    assert sequence.hold()
    return sequence


def test_it_calls_nothing_while_a_partner_is_missing() -> None:
    sequence = with_device()
    sequence.handle_missing(["service device/home"])
    assert sequence.next_call(1.0) is None
    sequence.check_time(89.9)
    assert outcome(sequence) is None
    sequence.check_time(90.0)
    assert "service device/home" in why(sequence)
    assert not sequence.touched


def test_it_repeats_calls_until_the_rig_is_ready_or_refuses() -> None:
    sequence = reach(CONFIRM)
    not_yet = "waiting for a subscriber of joint_states"
    sequence.handle_answer(CONFIRM, False, not_yet, 1.0)
    assert sequence.next_call(1.05) is None
    for now, refusal in ((20.0, not_yet), (20.2, "the needle is in"), (22.2, "the needle is in")):
        # The cause of a refusal may have changed meanwhile.
        assert outcome(sequence) is None
        assert sequence.next_call(now) == CONFIRM
        sequence.handle_answer(CONFIRM, False, refusal, now)
    assert "the needle is in" in why(sequence)


def test_a_service_that_never_answers_is_named() -> None:
    sequence = reach(CONFIRM)
    sequence.check_time(91.0)
    assert "no answer from device/confirm_needle_out" in why(sequence)


def test_a_call_is_repeated_if_its_answer_is_lost() -> None:
    for call in PREPARATION:
        sequence = reach(call)
        assert sequence.next_call(0.9 + CALL_TIMEOUT) is None
        assert sequence.next_call(1.0 + CALL_TIMEOUT) == call
        sequence.handle_answer(call, True, "", 2.1)
        following = sequence.next_call(2.1)
        if call == START:
            assert (following, sequence.hold()) == (None, True)
            continue
        assert following == PREPARATION[PREPARATION.index(call) + 1]
        for success in (True, False):
            sequence.handle_answer(call, success, "the device is MOVING", 2.2)
            assert not sequence.steering
            assert sequence.next_call(2.5) is None


def test_an_earlier_status_does_not_end_the_homing() -> None:
    sequence = reach(HOME)
    sequence.handle_answer(HOME, True, "homing", 1.0)
    assert sequence.next_call(1.0) is None
    # A device may still report homed from last time while it searches for its switches.
    for homed in (False, True):
        on_device(sequence, dataclasses.replace(MOVING, homed=homed), 2.0)
        assert sequence.next_call(2.0) is None
    on_device(sequence, DISABLED, 3.0)
    assert sequence.next_call(3.0) == ENABLE


def test_a_status_may_replace_the_answer_of_homing() -> None:
    overtaken, lost, stale = reach(HOME), reach(HOME), reach(HOME)
    on_device(overtaken, DISABLED)
    overtaken.handle_answer(HOME, True, "homing", 1.0)
    assert overtaken.next_call(1.0) == ENABLE
    on_device(lost, MOVING, 1.2)
    assert lost.next_call(5.0) is None, "it moves: not asked again"
    on_device(lost, DISABLED, 9.0)
    assert lost.next_call(9.0) == ENABLE
    # A homed status from before the call does not replace the answer.
    on_device(stale, dataclasses.replace(DISABLED, needle_out_confirmed=True), 1.1)
    assert stale.next_call(1.2) is None
    assert stale.next_call(1.0 + CALL_TIMEOUT) == HOME


def test_a_start_whose_answer_was_lost_is_known_from_the_status() -> None:
    sequence = reach(START)
    on_controller(sequence, 1.1, starts=0, state="IDLE")
    assert not sequence.hold()
    on_controller(sequence, 1.2)
    assert sequence.hold()
    sequence.handle_answer(START, False, "already steering", 1.3)
    assert outcome(sequence) is None
    assert sequence.next_call(9.0) is None


def test_start_requires_a_controller_status() -> None:
    sequence = without_status()
    sequence.handle_devices(["/sim_rig"])
    on_device(sequence, DISABLED)
    for _ in PREPARATION[:-1]:
        call = sequence.next_call(1.0)
        assert call is not None
        sequence.handle_answer(call, True, "", 1.0)
    assert sequence.next_call(1.0) is None
    assert "needle/controller_status" in sequence.pending_reason()
    on_controller(sequence, 1.1, state="DONE", starts=4)
    assert sequence.next_call(1.1) == START
    sequence.handle_answer(START, True, "", 1.1)
    assert outcome(sequence) is None


def test_the_outcome_names_the_reason() -> None:
    for state, reason in (("FAULT", "curvature lost"), ("IDLE", "stopped by hand")):
        sequence = reach()
        on_controller(sequence)
        on_controller(sequence, 3.0, state=state, reason=reason)
        assert reason in why(sequence)
    for state in ("FAULT", "ESTOPPED"):
        sequence = reach()
        on_device(sequence, dataclasses.replace(DISABLED, state=state, reason="button"))
        assert "button" in why(sequence)
    sequence = with_device()
    sequence.interrupt()
    assert why(sequence) == "interrupted"


def test_statuses_before_the_start_are_ignored() -> None:
    for state in ("DONE", "FAULT", "IDLE"):
        sequence = with_device()
        on_controller(sequence, 0.5, state=state)
        reach(None, sequence)
        on_controller(sequence, 2.0, state=state)
        assert outcome(sequence) is None
        on_controller(sequence, 2.0, starts=2)
        on_controller(sequence, 3.0, state="DONE", starts=2)
        assert sequence.outcome is not None
        assert sequence.outcome.code == 0


def test_a_start_that_ends_immediately_fails_the_run() -> None:
    """STEERING, then IDLE: a latched status of depth 1 may show only the second."""
    for state, overtakes in itertools.product(("FAULT", "IDLE"), (False, True)):
        sequence = with_device()
        on_controller(sequence, 0.5, state="IDLE")
        reach(START, sequence)
        if overtakes:
            on_controller(sequence, 1.0, state=state, starts=2, reason="the needle was drawn back")
        sequence.handle_answer(START, True, "", 1.0)
        if not overtakes:
            on_controller(sequence, 1.0, state=state, starts=2, reason="the needle was drawn back")
        assert "the needle was drawn back" in why(sequence)
        assert sequence.outcome is not None
        assert sequence.outcome.code == 1


def test_no_progress_releases_the_hold() -> None:
    sequence = reach()
    on_controller(sequence, 10.0)
    on_controller(sequence, 30.0)
    sequence.check_time(39.9)
    assert outcome(sequence) is None
    sequence.check_time(40.0)
    assert "no progress for 30 s at 3.0 mm" in why(sequence)


def test_an_ignored_press_is_released_and_repeated() -> None:
    for counted_before in (False, True):
        sequence = reach()
        if counted_before:
            on_device(sequence, dataclasses.replace(HOLDING, hold_owner="simulated_operator"), 1.1)
        on_device(sequence, dataclasses.replace(HOLDING, press_again="simulated_operator"), 9.0)
        assert not sequence.hold()
        on_device(sequence, HOLDING, 9.1)
        assert sequence.hold(), "the device has heard the release"
        # On a busy machine statuses arrive late: a step may be under way without one.
        on_device(sequence, dataclasses.replace(HOLDING, press_again="somebody"), 9.2)
        sequence.check_time(30.0)
        assert sequence.hold()


def test_a_real_device_ends_the_run() -> None:
    for wanted in (*PREPARATION, None):
        sequence = reach(wanted)
        sequence.handle_device(
            DeviceStatus(source="/device_driver", homed=True, simulated=False), 1.0
        )
        assert "/device_driver is a real device" in why(sequence)


def test_it_acts_only_on_a_single_simulated_device() -> None:
    sequence = without_status()
    sequence.handle_devices(["/device_driver"])
    assert sequence.next_call(1.0) is None, "nothing is known of it yet"
    on_device(sequence, FRESH)
    assert sequence.next_call(1.0) is None, "another said that"
    sequence.handle_devices(["/sim_rig", "/device_driver"])
    assert sequence.next_call(1.0) is None
    assert outcome(sequence) is None, "one that was killed counts for a while"
    sequence.check_time(90.0)
    assert "/sim_rig, /device_driver" in why(sequence)


def test_a_second_device_ends_the_run() -> None:
    sequence = reach()
    sequence.handle_devices(["/device_driver"])
    assert not sequence.hold(), "it has not said what it is"
    sequence.handle_devices(["/device_driver", "/sim_rig"])
    assert "more than one device: /device_driver, /sim_rig" in why(sequence)
