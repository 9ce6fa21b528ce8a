"""Hold and service calls of a retraction."""

from __future__ import annotations

from needle_console.hold.page_session import RELEASED, Mode, PageHold
from needle_console.hold.retraction import RETRACT, STOP_STEERING, HoldOrder, Retraction

INSERT = PageHold(True, 1.0, Mode.INSERT)
OUT = PageHold(True, 1.0, Mode.RETRACT)


def test_insertion_is_passed_on_unchanged() -> None:
    retraction = Retraction()
    for steering in (True, False):
        assert retraction.update(INSERT, 0.0, steering=steering, hold_counts=True) == HoldOrder(
            True
        )
        assert retraction.update(RELEASED, 9.0, steering=steering, hold_counts=False) == HoldOrder(
            False
        )


def test_retraction_stops_steering_first_and_calls_each_service_once() -> None:
    retraction = Retraction()
    assert retraction.update(OUT, 0.0, steering=True, hold_counts=False) == HoldOrder(
        False, (STOP_STEERING,)
    )
    assert retraction.update(OUT, 0.0, steering=True, hold_counts=False) == HoldOrder(False)
    assert retraction.update(OUT, 0.0, steering=False, hold_counts=False) == HoldOrder(True)
    assert retraction.update(OUT, 0.0, steering=False, hold_counts=True) == HoldOrder(
        True, (RETRACT,)
    )
    assert retraction.update(OUT, 0.0, steering=False, hold_counts=True) == HoldOrder(True)
    # The needle is out and the button still pressed: no second call, and no hold.
    assert retraction.update(OUT, 8.0, steering=False, hold_counts=False) == HoldOrder(True)
    assert retraction.update(OUT, 8.1, steering=False, hold_counts=True) == HoldOrder(False)
    assert retraction.update(OUT, 8.2, steering=True, hold_counts=False) == HoldOrder(False)
    assert retraction.update(RELEASED, 9.0, steering=False, hold_counts=False) == HoldOrder(False)
    assert retraction.update(OUT, 9.1, steering=False, hold_counts=True) == HoldOrder(
        True, (RETRACT,)
    )


def test_retraction_of_a_needle_that_is_out_ends_the_hold() -> None:
    retraction = Retraction()
    assert retraction.update(OUT, 0.0, steering=False, hold_counts=True) == HoldOrder(
        True, (RETRACT,)
    )
    assert retraction.update(OUT, 0.9, steering=False, hold_counts=True) == HoldOrder(True)
    assert retraction.update(OUT, 1.1, steering=False, hold_counts=True) == HoldOrder(False)
    # Steering that begins now gets no hold.
    assert retraction.update(OUT, 1.2, steering=True, hold_counts=False) == HoldOrder(False)


def test_steering_that_begins_meanwhile_gets_no_hold() -> None:
    retraction = Retraction()
    assert retraction.update(OUT, 0.0, steering=False, hold_counts=False) == HoldOrder(True)
    assert retraction.update(OUT, 0.0, steering=True, hold_counts=True) == HoldOrder(
        False, (STOP_STEERING,)
    )
