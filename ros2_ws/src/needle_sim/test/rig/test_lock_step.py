"""When time goes on and when an exposure is due, rule by rule (docs/architecture.md)."""

from __future__ import annotations

import itertools

import pytest

from needle_sim.rig.lock_step import MAX_WITHOUT_STEP, Action, LockStep

STAMP = 40_000_000
TICK, FRAME, DELAY = 20_000_000, 33_333_333, 40_000_000


def next_action(
    lock_step: LockStep,
    *,
    time_ns: int = STAMP,
    heard_command_ns: int = 0,
    under_way: bool = False,
    may_move: bool = False,
    held: bool = True,
    now: float = 0.0,
) -> Action:
    return lock_step.next_action(
        time_ns=time_ns,
        heard_command_ns=heard_command_ns,
        under_way=under_way,
        may_move=may_move,
        held=held,
        now=now,
    )


def new_lock_step(*, answered: bool) -> LockStep:
    return LockStep(
        answered=answered, reexpose_after=2.0, tick_ns=TICK, frame_ns=FRAME, path_delay_ns=DELAY
    )


@pytest.fixture(params=[False, True], ids=["tip", "camera"])
def lock_step(request: pytest.FixtureRequest) -> LockStep:
    return new_lock_step(answered=request.param)


def exposed_and_answered(lock_step: LockStep, *, found: bool = True) -> None:
    lock_step.exposed(STAMP, 0.0)
    lock_step.take_answer(STAMP, found, 0.0)


def test_nothing_is_due_before_anybody_said_anything(lock_step: LockStep) -> None:
    assert next_action(lock_step) is Action.WAIT
    assert next_action(lock_step, now=100.0) is Action.WAIT


def test_time_goes_on_while_a_step_moves_and_stands_while_its_hold_is_silent(
    lock_step: LockStep,
) -> None:
    lock_step.take_controller_status("STEERING", "tip", 10 * STAMP, 0.0)
    assert next_action(lock_step, under_way=True, may_move=True) is Action.TICK
    assert next_action(lock_step, under_way=True) is Action.WAIT


def test_rule_1_one_exposure_for_every_step_that_ended(lock_step: LockStep) -> None:
    exposed_and_answered(lock_step)
    lock_step.take_controller_status("STEERING", "result", 0, 0.0)
    assert next_action(lock_step) is Action.WAIT
    lock_step.step_ended(0.0)
    assert next_action(lock_step) is Action.EXPOSE
    exposed_and_answered(lock_step)
    assert next_action(lock_step) is Action.WAIT


@pytest.mark.parametrize(
    ("awaiting", "tip_after_ns", "due"),
    [
        ("tip", STAMP + 1, True),
        ("tip", STAMP, True),
        ("tip", STAMP - 1, False),
        ("result", STAMP, False),
        ("nothing", STAMP, False),
    ],
)
def test_rule_2_the_controller_wants_a_tip_that_no_exposure_gave(
    lock_step: LockStep, awaiting: str, tip_after_ns: int, due: bool
) -> None:
    exposed_and_answered(lock_step)
    lock_step.take_controller_status("STEERING", awaiting, tip_after_ns, 0.0)
    assert next_action(lock_step) is (Action.EXPOSE if due else Action.WAIT)


def test_rule_2_also_for_the_first_tip_of_all(lock_step: LockStep) -> None:
    lock_step.take_controller_status("STEERING", "tip", 0, 0.0)
    assert next_action(lock_step) is Action.EXPOSE


@pytest.mark.parametrize(
    ("state", "due"),
    [("STEERING", True), ("WAITING_FOR_TIP", True), ("IDLE", False), ("DONE", False)],
)
def test_rule_3_a_lost_tip_is_exposed_again_while_steering(
    lock_step: LockStep, state: str, due: bool
) -> None:
    lock_step.take_controller_status(state, "result", 0, 0.0)
    exposed_and_answered(lock_step, found=False)
    assert next_action(lock_step) is (Action.EXPOSE if due else Action.WAIT)
    exposed_and_answered(lock_step)
    assert next_action(lock_step) is Action.WAIT


def test_rule_4_silence_is_broken_and_counted_only_while_steering_and_held(
    lock_step: LockStep,
) -> None:
    exposed_and_answered(lock_step)
    lock_step.take_controller_status("STEERING", "tip", 0, 10.0)
    assert next_action(lock_step, now=11.9) is Action.WAIT
    assert next_action(lock_step, now=12.0, held=False) is Action.WAIT
    assert next_action(lock_step, now=13.9) is Action.WAIT
    assert lock_step.watchdog_trips == 0
    assert next_action(lock_step, now=14.0) is Action.EXPOSE
    assert lock_step.watchdog_trips == 1
    lock_step.exposed(2 * STAMP, 14.0)
    assert next_action(lock_step, now=15.0) is Action.WAIT
    lock_step.take_controller_status("DONE", "nothing", 0, 15.0)
    assert next_action(lock_step, now=99.0) is Action.WAIT


def test_an_unanswered_exposure_keeps_the_next_back_but_for_rule_4() -> None:
    lock_step = new_lock_step(answered=True)
    lock_step.take_controller_status("STEERING", "tip", 0, 0.0)
    lock_step.exposed(STAMP, 0.0)
    lock_step.step_ended(0.0)
    lock_step.take_answer(STAMP - 1, True, 0.0)
    assert next_action(lock_step) is Action.WAIT
    assert next_action(lock_step, now=2.0) is Action.EXPOSE
    lock_step.take_answer(STAMP, True, 0.0)
    assert next_action(lock_step) is Action.EXPOSE
    assert lock_step.watchdog_trips == 1


def test_exposures_without_a_step_have_a_bound_while_steering() -> None:
    lock_step = new_lock_step(answered=True)

    def expose(count: int, *, found: bool) -> None:
        for number in range(count):
            lock_step.exposed(STAMP + number, 0.0)
            lock_step.take_answer(STAMP + number, found, 0.0)

    lock_step.take_controller_status("IDLE", "nothing", 0, 0.0)
    expose(2 * MAX_WITHOUT_STEP, found=False)
    assert lock_step.why_stuck == ""
    lock_step.take_controller_status("STEERING", "tip", 0, 0.0)
    expose(MAX_WITHOUT_STEP - 1, found=False)
    assert lock_step.why_stuck == ""
    lock_step.step_ended(0.0)
    expose(MAX_WITHOUT_STEP - 1, found=True)
    assert lock_step.why_stuck == ""
    expose(1, found=True)
    assert lock_step.why_stuck == "60 exposures since the last step, and no tip led to one"
    expose(1, found=False)
    assert lock_step.why_stuck == "61 exposures since the last step, and no tip was found"


def continuous(
    lock_step: LockStep, *, tip_after_ns: int = 0, command_ns: int = 0, awaiting: str = "tip"
) -> None:
    lock_step.take_controller_status(
        "STEERING", awaiting, tip_after_ns, 0.0, continuous=True, command_ns=command_ns
    )


def test_continuously_time_goes_on_and_frames_come_at_their_rate() -> None:
    lock_step = new_lock_step(answered=False)
    continuous(lock_step)
    time_ns, exposures = STAMP, []
    for _ in range(50):
        action = next_action(lock_step, time_ns=time_ns, heard_command_ns=time_ns)
        time_ns += TICK
        if action is Action.EXPOSE:
            exposures.append(time_ns)
            lock_step.exposed(time_ns, 0.0)
            continuous(lock_step, tip_after_ns=time_ns, command_ns=time_ns)
        else:
            assert action is Action.TICK
    assert {b - a for a, b in itertools.pairwise(exposures)} == {2 * TICK}


def test_continuously_time_waits_where_an_answer_is_due_that_has_not_come() -> None:
    lock_step = new_lock_step(answered=False)
    continuous(lock_step)
    lock_step.exposed(STAMP, 0.0)
    assert next_action(lock_step, time_ns=STAMP) is Action.TICK
    assert next_action(lock_step, time_ns=STAMP + TICK) is Action.WAIT
    continuous(lock_step, tip_after_ns=STAMP, command_ns=STAMP)
    # The controller has answered, the device has not heard it.
    assert next_action(lock_step, time_ns=STAMP + TICK) is Action.WAIT
    heard = next_action(lock_step, time_ns=STAMP + TICK, heard_command_ns=STAMP)
    assert heard is Action.EXPOSE


def test_continuously_a_tip_that_was_not_found_is_an_answer() -> None:
    lock_step = new_lock_step(answered=True)
    continuous(lock_step)
    lock_step.exposed(STAMP, 0.0)
    assert next_action(lock_step, time_ns=STAMP + TICK) is Action.WAIT
    lock_step.take_answer(STAMP, False, 0.0)
    assert next_action(lock_step, time_ns=STAMP + TICK) is Action.EXPOSE


@pytest.mark.parametrize("insertion", ["stepwise", "continuous"])
def test_silence_while_nobody_holds_is_none(insertion: str) -> None:
    lock_step = new_lock_step(answered=True)
    lock_step.take_controller_status(
        "STEERING", "tip", 0, 0.0, continuous=insertion == "continuous"
    )
    lock_step.exposed(STAMP, 0.0)
    time_ns = STAMP + TICK
    for now in (1.0, 9.0):
        assert next_action(lock_step, held=False, time_ns=time_ns, now=now) is Action.WAIT
    assert next_action(lock_step, time_ns=time_ns, now=9.1) is Action.WAIT
    assert next_action(lock_step, time_ns=time_ns, now=11.1) is Action.EXPOSE
    assert lock_step.watchdog_trips == 1


def test_continuously_a_needle_that_is_paused_gets_no_frames() -> None:
    lock_step = new_lock_step(answered=False)
    continuous(lock_step)
    assert next_action(lock_step, under_way=True) is Action.WAIT
    assert next_action(lock_step, under_way=True, may_move=True) is Action.EXPOSE


def test_continuously_time_stands_still_without_hold_and_goes_on_after_a_long_silence() -> None:
    lock_step = new_lock_step(answered=False)
    continuous(lock_step)
    assert next_action(lock_step, held=False) is Action.WAIT
    continuous(lock_step, awaiting="hold")
    assert next_action(lock_step) is Action.WAIT
    continuous(lock_step)
    lock_step.exposed(STAMP, 0.0)
    assert next_action(lock_step, time_ns=STAMP + TICK, now=2.1) is Action.EXPOSE
    assert lock_step.watchdog_trips == 1
