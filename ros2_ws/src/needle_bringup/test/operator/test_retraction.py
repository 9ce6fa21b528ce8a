"""Retraction with a held button: no hold while a controller steers."""

from __future__ import annotations

from needle_bringup.operator.retraction import (
    RETRACT,
    STEP_TIMEOUT,
    STOP_STEERING,
    RetractionSequence,
)

IN_VAIN = (
    f"no answer from {STOP_STEERING}",
    "the device ignores the hold",
    f"no answer from {RETRACT}",
    "the needle is out",
)


def holds(retraction: RetractionSequence) -> bool:
    """Return the hold; a call, because mypy would narrow the attribute."""
    return retraction.holds


def at_step(steps: int) -> RetractionSequence:
    """Return the retraction of a button after a number of steps, at 1 s.

    Steps: the controller has stopped, the device was asked to retract, and it has accepted.
    """
    retraction = RetractionSequence("operator")
    retraction.handle_device("", "none", 0.0)
    assert retraction.update(True, 1.0, controller=True) == STOP_STEERING
    assert retraction.update(True, 1.0, controller=True) is None
    assert not holds(retraction)
    if steps > 0:
        retraction.handle_answer(STOP_STEERING, True, "stopped", 1.0)
    if steps > 1:
        retraction.handle_device("operator", "none", 1.0)
        assert retraction.update(True, 1.0, controller=True) == RETRACT
        assert retraction.update(True, 1.0, controller=True) is None
    if steps > 2:
        retraction.handle_answer(RETRACT, True, "retracting", 1.0)
    assert holds(retraction) is (steps > 0)
    return retraction


def test_the_hold_ends_with_the_retraction() -> None:
    for answer_last in (False, True):
        retraction = at_step(2 if answer_last else 3)
        retraction.handle_device("operator", "retraction", 1.15)
        if answer_last:
            retraction.handle_answer(RETRACT, True, "retracting", 1.2)
        assert retraction.update(True, 60.0, controller=False) is None
        assert holds(retraction)
        retraction.handle_device("operator", "none", 61.0)
        assert retraction.update(True, 61.1, controller=False) is None
        assert not holds(retraction)
        assert retraction.problem == ""


def test_without_a_controller_the_hold_starts_immediately() -> None:
    retraction = RetractionSequence("operator")
    assert retraction.update(True, 1.0, controller=False) is None
    assert holds(retraction)


def test_a_release_ends_the_sequence_and_a_new_press_restarts_it() -> None:
    retraction = at_step(3)
    assert retraction.update(False, 2.0, controller=True) is None
    # The answer to the earlier request comes too late.
    retraction.handle_answer(STOP_STEERING, True, "stopped", 2.1)
    assert not holds(retraction)
    assert retraction.update(True, 3.0, controller=True) == STOP_STEERING


def test_a_refusal_ends_the_hold_and_is_reported() -> None:
    for steps, service in ((0, STOP_STEERING), (2, RETRACT)):
        retraction = at_step(steps)
        retraction.handle_answer(service, False, "not now", 1.2)
        assert not holds(retraction)
        assert retraction.problem == f"{service} was refused: not now"


def test_a_timeout_ends_the_hold() -> None:
    for steps, cause in enumerate(IN_VAIN):
        retraction = at_step(steps)
        assert retraction.update(True, 1.0 + 0.99 * STEP_TIMEOUT, controller=True) is None
        assert not retraction.problem
        retraction.update(True, 1.0 + 1.01 * STEP_TIMEOUT, controller=True)
        assert not holds(retraction)
        assert cause in retraction.problem
