"""The witness tells by whose press anything may move."""

from __future__ import annotations

import pytest

from scenario.judging.hold_witness import HoldWitness

ONE, OTHER = "one", "other"


def hold(witness: HoldWitness, sender: str, begin: float, end: float) -> None:
    """Let a sender press from begin to end [s], 50 times a second."""
    for tick in range(round(begin * 50), round(end * 50) + 1):
        witness.hear(tick / 50, sender, pressed=True, lifetime=0.1)


def release(witness: HoldWitness, sender: str, at: float) -> None:
    witness.hear(at, sender, pressed=False, lifetime=0.1)


@pytest.fixture
def beside() -> HoldWitness:
    """Witness of two who press, one of them the owner, for a second."""
    witness = HoldWitness()
    hold(witness, ONE, 0.0, 0.5)
    witness.see_owner(0.5, ONE)
    for tick in range(25, 51):
        for sender in (ONE, OTHER):
            hold(witness, sender, tick / 50, tick / 50)
    witness.see_owner(1.0, ONE)
    return witness


def test_who_pressed_beside_the_owner_takes_nothing_over(beside: HoldWitness) -> None:
    release(beside, ONE, 1.02)
    beside.see_owner(1.02, "")
    hold(beside, OTHER, 1.04, 2.0)
    assert beside.idle(2.0) == pytest.approx(0.98)


def test_who_pressed_beside_the_owner_keeps_nothing_alive(beside: HoldWitness) -> None:
    hold(beside, OTHER, 1.02, 2.0)
    assert beside.idle(2.0) == pytest.approx(0.9)


def test_a_new_press_may_move(beside: HoldWitness) -> None:
    release(beside, OTHER, 1.02)
    release(beside, ONE, 1.02)
    beside.see_owner(1.02, "")
    hold(beside, OTHER, 1.1, 2.0)
    assert beside.idle(2.0) == 0.0


def test_a_stop_takes_the_hold_from_who_presses_on(beside: HoldWitness) -> None:
    beside.see_owner(1.02, "")
    hold(beside, ONE, 1.04, 2.0)
    assert beside.idle(2.0) == pytest.approx(0.98)


def test_a_device_that_was_started_again_knows_nobody(beside: HoldWitness) -> None:
    beside.see_owner(1.02, "")
    beside.forget()
    hold(beside, OTHER, 1.5, 2.0)
    assert beside.idle(2.0) == 0.0


def test_a_press_by_which_it_moved_when_the_device_ended_counts_until_then(
    beside: HoldWitness,
) -> None:
    beside.lose_device(1.02)
    beside.see_owner(1.5, "")
    assert beside.idle(1.1) == pytest.approx(0.08)
