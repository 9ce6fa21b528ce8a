"""Drawing out by a held button: never a hold beside a controller that steers."""

import pytest

from needle_bringup.operator.retraction import PATIENCE, RETRACT, STOP_STEERING, Retraction


def holds(retraction: Retraction) -> bool:
    """What mypy takes for the same after a call may have changed."""
    return retraction.holds


def begin(*, controller: bool = False) -> Retraction:
    retraction = Retraction("operator")
    retraction.see_device("", "none", 0.0)
    call = retraction.look(True, 1.0, controller=controller)
    assert call == (STOP_STEERING if controller else None)
    assert holds(retraction) is not controller
    return retraction


def draw(retraction: Retraction) -> None:
    """Bring it to where the needle leaves."""
    retraction.see_device("operator", "none", 1.1)
    assert retraction.look(True, 1.1, controller=True) == RETRACT
    assert retraction.look(True, 1.1, controller=True) is None
    retraction.take_answer(RETRACT, True, "retracting", 1.2)
    retraction.see_device("operator", "retraction", 1.3)


def test_a_controller_stops_before_anything_is_held() -> None:
    retraction = begin(controller=True)
    assert retraction.look(True, 1.02, controller=True) is None
    assert not holds(retraction)
    retraction.take_answer(STOP_STEERING, True, "stopped", 1.05)
    assert holds(retraction)
    draw(retraction)
    assert holds(retraction)


@pytest.mark.parametrize("answer_last", [False, True])
def test_the_hold_ends_with_the_retraction_though_the_button_is_held(answer_last: bool) -> None:
    retraction = begin()
    if answer_last:
        retraction.see_device("operator", "none", 1.1)
        assert retraction.look(True, 1.1, controller=False) == RETRACT
        retraction.see_device("operator", "retraction", 1.15)
        retraction.take_answer(RETRACT, True, "retracting", 1.2)
    else:
        draw(retraction)
    assert retraction.look(True, 60.0, controller=False) is None
    assert holds(retraction)
    retraction.see_device("operator", "none", 61.0)
    assert not holds(retraction)
    assert retraction.look(True, 61.1, controller=False) is None
    assert not holds(retraction)
    assert retraction.trouble == ""


def test_a_release_ends_it_and_a_new_press_begins_it_anew() -> None:
    retraction = begin(controller=True)
    retraction.take_answer(STOP_STEERING, True, "stopped", 1.05)
    draw(retraction)
    assert retraction.look(False, 2.0, controller=True) is None
    assert not holds(retraction)
    # What was asked for before comes too late.
    retraction.take_answer(STOP_STEERING, True, "stopped", 2.1)
    assert not holds(retraction)
    assert retraction.look(True, 3.0, controller=True) == STOP_STEERING


@pytest.mark.parametrize("service", [STOP_STEERING, RETRACT])
def test_a_refusal_ends_the_hold_and_is_said(service: str) -> None:
    retraction = begin(controller=service == STOP_STEERING)
    if service == RETRACT:
        retraction.see_device("operator", "none", 1.1)
        retraction.look(True, 1.1, controller=False)
    retraction.take_answer(service, False, "not now", 1.2)
    assert not holds(retraction)
    assert retraction.trouble == f"{service} was refused: not now"


@pytest.mark.parametrize(
    ("steps", "said"),
    [
        (0, f"no answer from {STOP_STEERING}"),
        (1, "does not take the hold"),
        (2, f"no answer from {RETRACT}"),
        (3, "the needle is out"),
    ],
)
def test_what_does_not_come_ends_the_hold(steps: int, said: str) -> None:
    retraction = begin(controller=True)
    if steps > 0:
        retraction.take_answer(STOP_STEERING, True, "stopped", 1.0)
    if steps > 1:
        retraction.see_device("operator", "none", 1.0)
        retraction.look(True, 1.0, controller=True)
    if steps > 2:
        retraction.take_answer(RETRACT, True, "the needle is out", 1.0)
    assert retraction.look(True, 1.0 + 0.99 * PATIENCE, controller=True) is None
    assert not retraction.trouble
    retraction.look(True, 1.0 + 1.01 * PATIENCE, controller=True)
    assert not holds(retraction)
    assert said in retraction.trouble
