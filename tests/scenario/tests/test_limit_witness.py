"""What is within the limits, and what is beyond."""

from __future__ import annotations

import itertools
import math
import random

import pytest

from scenario.judging.limit_witness import Bounds, LimitWitness, Pace

BOUNDS = Bounds(0.2, 0.005, 63.0, 3.14, 0.0005, 0.1)
PERIOD = 0.02


def said_of_motors(*ways: tuple[float, float, float]) -> list[str]:
    """Return what is said of motors that go for [s] at [m/s] and [rad/s], one after another."""
    witness, at, insertion, rotation = LimitWitness(BOUNDS), 0.0, 0.01, 0.0
    said: list[str] = []
    for lasts, speed, rate in ways:
        for _ in range(round(lasts / 0.005)):
            at, insertion, rotation = at + 0.005, insertion + 0.005 * speed, rotation + 0.005 * rate
            said += witness.see_motors(at, insertion, rotation)
    return said


def test_a_pace_is_of_all_spans() -> None:
    rng = random.Random(1)
    ways = [(0.1 * n, rng.uniform(-1.0, 1.0)) for n in range(40)]
    pace = Pace(3.0)
    for n, (at, place) in enumerate(ways):
        spans = itertools.product(ways[: n + 1], (1.0, -1.0))
        wanted = max(sign * (place - at_) - 3.0 * (at - then) for (then, at_), sign in spans)
        assert pace.ahead(at, place) == pytest.approx(wanted)


def test_motors_at_their_limit_go_on_for_ever() -> None:
    assert not said_of_motors((20.0, 0.005, 3.14), (20.0, -0.005, -3.14))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_motors_a_little_faster_are_found(sign: float) -> None:
    assert "insertion went" in said_of_motors((20.0, sign * 0.0051, 0.0))[0]
    assert "rotation went" in said_of_motors((20.0, 0.0, sign * 3.2))[0]


def test_a_drive_catches_up_by_its_following_error_and_no_more() -> None:
    # Half of a millimetre and three set-points of 0.1 mm; 0.1 rad and three of 63 mrad.
    jump = 0.005 + 0.0007 / 0.005, 3.14 + 0.27 / 0.005
    farther = 0.005 + 0.0009 / 0.005, 3.14 + 0.31 / 0.005
    running = (1.0, 0.005, 3.14)
    assert not said_of_motors(running, (0.005, *jump), running)
    assert len(said_of_motors(running, (0.005, *farther))) == 2
    # What was caught up once is not allowed anew.
    assert len(said_of_motors(running, (0.005, *jump), running, (0.005, *jump))) == 2
    assert not said_of_motors(running, (0.005, *jump), (1.0, 0.0, 0.0), (0.005, *jump))


@pytest.mark.parametrize(
    ("insertion", "rotation", "said"),
    [
        (0.2, 63.0, ""),
        (0.2012, 0.0, "insertion is 201.2 mm, at most 201.1"),
        (0.0, -63.4, "rotation is -63.4 rad, at most 63.3 either way"),
    ],
)
def test_places_have_their_limits(insertion: float, rotation: float, said: str) -> None:
    assert "".join(LimitWitness(BOUNDS).see_motors(0.0, insertion, rotation)) == said


def test_set_points_are_no_faster_than_their_limit() -> None:
    witness = LimitWitness(BOUNDS)

    def send(at: float, place: float | None, axis: int = 0) -> bool:
        return bool(list(witness.see_set_point(at, axis, place)))

    assert not any(send(n * PERIOD, n * PERIOD * 0.005) for n in range(100))
    # One may be early, a second one may not.
    assert not send(100 * PERIOD, 101 * PERIOD * 0.00499)
    assert send(101 * PERIOD, 103 * PERIOD * 0.005)
    assert not send(101 * PERIOD, 3.0, axis=1)
    # A drive that was not to go there begins anew wherever it is.
    assert not send(102 * PERIOD, None)
    assert not send(103 * PERIOD, math.pi)


def test_what_was_sent_late_may_be_followed_so_much_sooner() -> None:
    for late, is_beyond in ((0.0, True), (0.005, False)):
        witness = LimitWitness(BOUNDS, late)
        places = [(0.005, 0.0), (0.021, 1e-4), (0.022, 2e-4)]
        said = [text for at, place in places for text in witness.see_set_point(at, 0, place)]
        assert bool(said) is is_beyond
