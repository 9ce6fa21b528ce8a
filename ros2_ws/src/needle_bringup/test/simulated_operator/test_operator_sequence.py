import pytest

from needle_bringup.simulated_operator.operator_sequence import (
    HOME,
    PREPARATION,
    START,
    OperatorSequence,
    ServiceCall,
)
from needle_core.status_messages import DeviceStatus

from .sequences import CONFIRM, DISABLED, answer, fresh, outcome, prepare, reach, see, steering


def test_calls_the_services_in_order_and_holds_only_after_all_have_agreed() -> None:
    sequence = fresh()
    sequence.see_missing([])
    see(sequence, {"homed": "true"}, 1.0)
    for expected in PREPARATION:
        assert not sequence.hold()
        assert sequence.next_call(1.0) == expected
        assert sequence.next_call(1.0) is None, "one call at a time"
        sequence.take_answer(expected, True, "", 1.0)
    assert sequence.hold()


def test_calls_nothing_while_a_partner_is_missing() -> None:
    sequence = fresh()
    assert sequence.next_call(1.0) is None
    sequence.see_missing(["service device/home"])
    assert sequence.next_call(1.0) is None
    sequence.check_time(29.9)
    assert outcome(sequence) is None
    sequence.check_time(30.0)
    assert sequence.outcome is not None
    assert not sequence.outcome.done
    assert "service device/home" in sequence.outcome.reason
    assert not sequence.touched


def test_asks_again_where_the_rig_is_not_ready_yet_and_gives_up_where_it_refuses() -> None:
    sequence = fresh()
    sequence.see_missing([])
    assert sequence.next_call(1.0) == PREPARATION[0]
    sequence.take_answer(CONFIRM, False, "waiting for a subscriber of joint_states", 1.0)
    assert sequence.next_call(1.05) is None
    assert sequence.next_call(20.0) == PREPARATION[0]
    sequence.take_answer(CONFIRM, False, "waiting for a subscriber of joint_states", 20.0)
    assert sequence.next_call(20.2) == PREPARATION[0]
    sequence.take_answer(CONFIRM, False, "the needle is in", 20.2)
    assert outcome(sequence) is None, "what it rests on may have changed meanwhile"
    assert sequence.next_call(22.2) == PREPARATION[0]
    sequence.take_answer(CONFIRM, False, "the needle is in", 22.2)
    assert sequence.outcome is not None
    assert "the needle is in" in sequence.outcome.reason
    assert sequence.next_call(23.0) is None


def test_a_service_that_never_answers_is_named() -> None:
    sequence = fresh()
    sequence.see_missing([])
    sequence.next_call(1.0)
    sequence.check_time(31.0)
    assert sequence.outcome is not None
    assert "no answer from device/confirm_needle_out" in sequence.outcome.reason


def test_waits_for_homing_before_it_enables() -> None:
    sequence = fresh()
    sequence.see_missing([])
    for _ in range(2):
        answer(sequence)
    assert sequence.next_call(1.0) is None
    see(sequence, {"homed": "true"}, 1.0)
    assert sequence.next_call(1.0) == ServiceCall("device/enable", True)


def test_done_is_success_and_releases_the_hold() -> None:
    sequence = fresh()
    prepare(sequence)
    sequence.see_controller(steering(), 2.0)
    assert sequence.hold()
    sequence.see_controller(steering(state="DONE", step="120", insertion_m="0.12"), 3.0)
    assert sequence.outcome is not None
    assert sequence.outcome.done
    assert not sequence.hold()


def test_the_done_of_an_earlier_run_does_not_count() -> None:
    sequence = fresh()
    sequence.see_controller(steering(state="DONE"), 0.5)
    prepare(sequence)
    sequence.see_controller(steering(state="DONE"), 2.0)
    assert sequence.outcome is None


def test_fault_release_and_stop_end_the_run_with_their_reason() -> None:
    for state, reason in (("FAULT", "curvature lost"), ("IDLE", "stopped by hand")):
        sequence = fresh()
        prepare(sequence)
        sequence.see_controller(steering(), 2.0)
        sequence.see_controller(steering(state=state, reason=reason), 3.0)
        assert sequence.outcome is not None
        assert not sequence.outcome.done
        assert reason in sequence.outcome.reason
        assert not sequence.hold()
    for state in ("FAULT", "ESTOPPED"):
        sequence = fresh()
        prepare(sequence)
        see(sequence, {"homed": "true", "state": state, "reason": "button"}, 1.0)
        assert sequence.outcome is not None
        assert "button" in sequence.outcome.reason


def test_the_idle_before_steering_is_no_stop() -> None:
    sequence = fresh()
    prepare(sequence)
    sequence.see_controller(steering(state="IDLE", starts="0"), 2.0)
    assert sequence.outcome is None


def test_no_progress_releases_the_hold() -> None:
    sequence = fresh()
    prepare(sequence)
    sequence.see_controller(steering(), 10.0)
    sequence.see_controller(steering(), 60.0)
    sequence.check_time(69.9)
    assert outcome(sequence) is None
    sequence.check_time(70.0)
    assert not sequence.hold()
    assert sequence.outcome is not None
    assert "no progress for 60 s at 3.0 mm" in sequence.outcome.reason


@pytest.mark.parametrize("counted_before", [False, True])
def test_a_press_that_does_not_count_is_released_and_pressed_again(counted_before: bool) -> None:
    sequence = fresh()
    prepare(sequence, 1.0)
    holding = {"homed": "true", "state": "HOLDING"}
    if counted_before:
        see(sequence, holding | {"hold_owner": "simulated_operator"}, 1.1)
    see(sequence, holding | {"press_again": "simulated_operator"}, 9.0)
    assert not sequence.hold()
    see(sequence, holding, 9.1)
    assert sequence.hold(), "the device has heard the release"
    assert sequence.presses_again == 1
    see(sequence, holding | {"hold_owner": "simulated_operator"}, 9.2)
    assert sequence.hold()
    assert sequence.presses_again == 1


def test_a_press_that_the_device_says_nothing_of_stays() -> None:
    """On a busy machine news come late: what counts meanwhile may be a step under way."""
    sequence = fresh()
    prepare(sequence, 1.0)
    for values in ({}, {"hold_owner": ""}, {"press_again": "somebody"}):
        see(sequence, {"homed": "true", "state": "HOLDING"} | values, 1.1)
        sequence.check_time(50.0)
        assert sequence.hold()


def test_an_interrupt_ends_it_at_any_time_and_keeps_its_first_outcome() -> None:
    sequence = fresh()
    sequence.interrupt()
    assert sequence.outcome is not None
    assert sequence.outcome.interrupted
    sequence.see_missing([])
    assert sequence.next_call(1.0) is None
    finished = fresh()
    prepare(finished)
    finished.see_controller(steering(state="DONE"), 3.0)
    finished.interrupt()
    assert finished.outcome is not None
    assert finished.outcome.done


def test_a_fault_that_overtakes_the_answer_to_start_ends_the_run() -> None:
    sequence = fresh()
    sequence.see_missing([])
    see(sequence, DISABLED, 1.0)
    for _ in PREPARATION[:-1]:
        answer(sequence)
    assert sequence.next_call(1.0) == START
    sequence.see_controller(steering(state="FAULT", reason="the needle is gone"), 1.0)
    assert sequence.outcome is not None
    assert "the needle is gone" in sequence.outcome.reason
    assert sequence.outcome.prepared


@pytest.mark.parametrize("prepared", range(len(PREPARATION) + 1))
def test_a_device_that_is_real_ends_it_whenever_it_is_heard(prepared: int) -> None:
    sequence = fresh()
    sequence.see_missing([])
    see(sequence, {"homed": "true"}, 1.0)
    for _ in range(prepared):
        answer(sequence)
    status = DeviceStatus(source="/device_driver", homed=True, simulated=False)
    sequence.see_device(status, 1.0)
    assert sequence.outcome is not None
    assert "/device_driver is a real device" in sequence.outcome.reason
    assert sequence.next_call(2.0) is None
    assert not sequence.hold()


def test_it_acts_only_on_a_device_that_is_alone_and_has_said_that_it_is_simulated() -> None:
    sequence = OperatorSequence(0.0, "simulated_operator", wait_timeout=30.0, stall_timeout=60.0)
    sequence.see_missing([])
    sequence.see_devices(["/device_driver"])
    assert sequence.next_call(1.0) is None, "nothing is known of it yet"
    see(sequence, {}, 1.0)
    assert sequence.next_call(1.0) is None, "another said that"
    sequence.see_devices(["/sim_rig", "/device_driver"])
    assert sequence.next_call(1.0) is None
    assert outcome(sequence) is None, "one that was killed counts for a while"
    sequence.check_time(30.0)
    assert sequence.outcome is not None
    assert "/sim_rig, /device_driver" in sequence.outcome.reason


def test_a_second_device_ends_it_and_one_that_took_the_place_is_not_held() -> None:
    sequence = fresh()
    prepare(sequence)
    assert sequence.hold()
    sequence.see_devices(["/device_driver"])
    assert not sequence.hold(), "it has not said what it is"
    sequence.see_devices(["/device_driver", "/sim_rig"])
    assert sequence.outcome is not None
    assert "more than one device: /device_driver, /sim_rig" in sequence.outcome.reason


def test_a_homing_under_way_is_waited_for_whatever_was_heard_before_it() -> None:
    sequence = fresh()
    sequence.see_missing([])
    see(sequence, {"homed": "true", "state": "DISABLED"}, 1.0)
    answer(sequence, "needle out")
    assert sequence.next_call(1.0) == ServiceCall("device/home")
    sequence.take_answer(HOME, True, "homing", 1.0)
    assert sequence.next_call(1.0) is None
    # A device may say that it is homed, from last time, while it looks for its switches.
    for homed in ("false", "true"):
        see(sequence, {"homed": homed, "state": "MOVING"}, 2.0)
        assert sequence.next_call(2.0) is None
    see(sequence, {"homed": "true", "state": "DISABLED"}, 3.0)
    assert sequence.next_call(3.0) == ServiceCall("device/enable", True)


def test_the_end_of_a_homing_may_overtake_its_answer() -> None:
    sequence = fresh()
    sequence.see_missing([])
    answer(sequence, "needle out")
    assert sequence.next_call(1.0) == HOME
    see(sequence, {"homed": "true", "state": "DISABLED"}, 1.0)
    sequence.take_answer(HOME, True, "homing", 1.0)
    assert sequence.next_call(1.0) == ServiceCall("device/enable", True)


def test_a_start_that_ends_at_once_is_not_waited_for() -> None:
    """STEERING, then IDLE: a latched status of depth 1 may show the second alone."""
    for overtakes in (False, True):
        sequence = fresh()
        sequence.see_controller(steering(state="IDLE", starts="1", reason="stopped"), 0.5)
        sequence.see_missing([])
        see(sequence, {"homed": "true", "state": "DISABLED"}, 1.0)
        for _ in PREPARATION[:-1]:
            answer(sequence)
        assert sequence.next_call(1.0) == START
        ended = steering(state="IDLE", starts="2", reason="the needle was drawn back")
        if overtakes:
            sequence.see_controller(ended, 1.0)
        sequence.take_answer(START, True, "", 1.0)
        if not overtakes:
            sequence.see_controller(ended, 1.0)
        assert sequence.outcome is not None
        assert "the needle was drawn back" in sequence.outcome.reason


def test_what_was_said_before_this_start_is_of_another_run() -> None:
    for state in ("DONE", "FAULT", "IDLE"):
        sequence = fresh()
        old = steering(state=state, starts="1")
        sequence.see_controller(old, 0.5)
        prepare(sequence)
        sequence.see_controller(old, 2.0)
        assert outcome(sequence) is None
        sequence.see_controller(steering(starts="2"), 2.0)
        sequence.see_controller(steering(state="DONE", starts="2"), 3.0)
        assert sequence.outcome is not None
        assert sequence.outcome.done


def test_before_it_acts_another_device_has_time_to_show_itself() -> None:
    sequence = OperatorSequence(
        0.0, "simulated_operator", wait_timeout=30.0, stall_timeout=60.0, look_around=2.0
    )
    sequence.see_missing([])
    sequence.see_devices(["/sim_rig"])
    see(sequence, {}, 0.1)
    assert sequence.next_call(1.9) is None
    assert sequence.next_call(2.0) == PREPARATION[0]


def test_nothing_is_started_before_the_controller_has_said_how_often_it_was() -> None:
    sequence = OperatorSequence(0.0, "simulated_operator", wait_timeout=30.0, stall_timeout=60.0)
    sequence.see_missing([])
    sequence.see_devices(["/sim_rig"])
    see(sequence, DISABLED, 1.0)
    for _ in PREPARATION[:-1]:
        answer(sequence)
    assert sequence.next_call(1.0) is None
    assert "needle/controller_status" in sequence.hangs()
    sequence.see_controller(steering(state="DONE", starts="4"), 1.1)
    assert sequence.next_call(1.1) == START
    sequence.take_answer(START, True, "", 1.1)
    assert outcome(sequence) is None


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "two", ""])
def test_figures_that_are_none_end_nothing(text: str) -> None:
    sequence = reach(START)
    sequence.see_controller(steering(starts=text, insertion_m=text, depth_m=text), 1.1)
    assert outcome(sequence) is None
    assert not sequence.steering
