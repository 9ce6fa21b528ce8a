"""Which press counts, by a rule that looks back from each moment; a joystick must go on talking."""

from __future__ import annotations

import math

from hypothesis import given, settings
from hypothesis import strategies as st

from needle_bringup.operator.controls import Controls
from needle_bringup.operator.hand import Hand, Lost, Reading
from needle_bringup.operator.hold_gate import LONGEST_GAP, Held, HoldGate
from needle_bringup.operator.joy_source import LONGEST_SILENCE, JoySource

CYCLE = 0.02
INSERT, RETRACT, NEUTRAL = Hand(insert=True), Hand(retract=True), Hand()
WANTS: dict[Reading, Held] = {INSERT: Held.INSERT, RETRACT: Held.RETRACT}
BOTH, STOPPED = Hand(insert=True, retract=True), Hand(insert=True, stop=True)
READINGS = (NEUTRAL, INSERT, RETRACT, BOTH, Hand(stop=True), STOPPED, Lost("unplugged"))
moments = st.tuples(st.sampled_from(READINGS), st.sampled_from((CYCLE, CYCLE, CYCLE, 0.15)))
CONTROLS = Controls(insert=0, retract=2, speed_axis=1, axis_at_zero=0.0, axis_at_full=1.0)

NO_HANDS: tuple[tuple[int, list[float], list[int], str], ...] = (
    (2, [0.0, 1.0], [1, 0, 0], "2 nodes publish"),
    (1, [0.0, 1.0], [1, 0], "has 2 buttons, none 2"),
    (1, [0.0], [1, 0, 0], "has 1 axes, none 1"),
    (1, [0.0, math.nan], [1, 0, 0], "axis 1 is nan"),
)


def counts(seen: list[tuple[Reading, float]]) -> Held:
    """Return what may be held at the last moment, looking back: itself alone, since neutral."""
    last = seen[-1][0]
    for reading, gap in reversed(seen):
        if reading == NEUTRAL:
            return WANTS.get(last, Held.NOTHING)
        if reading != last or last not in WANTS or gap > LONGEST_GAP:
            break
    return Held.NOTHING


@settings(max_examples=60, deadline=None)
@given(st.lists(moments, min_size=1, max_size=30))
def test_only_a_fresh_press_out_of_neutral_counts_and_as_long_as_it_lasts(
    seen: list[tuple[Reading, float]],
) -> None:
    gate, now = HoldGate(), 0.0
    # Before the first look there is no gap.
    seen[0] = (seen[0][0], 0.0)
    for number, (reading, gap) in enumerate(seen):
        now += gap
        grip = gate.take(reading, now)
        assert grip.held is counts(seen[: number + 1])
        assert bool(grip.trouble) is isinstance(reading, Lost)


def test_a_stop_is_asked_for_once_a_press_and_ends_what_is_held() -> None:
    gate = HoldGate()
    readings = (NEUTRAL, INSERT, STOPPED, STOPPED, INSERT, NEUTRAL, Hand(stop=True))
    grips = [gate.take(reading, CYCLE * number) for number, reading in enumerate(readings)]
    assert [grip.stop for grip in grips] == [False, False, True, False, False, False, True]
    assert [grip.held is Held.INSERT for grip in grips] == [False, True, *[False] * 5]


def test_a_stop_that_is_pressed_when_the_source_comes_back_is_asked_for_anew() -> None:
    gate = HoldGate()
    pressed = Hand(stop=True)
    readings: list[Reading] = [pressed, Lost("unplugged"), pressed, pressed]
    grips = [gate.take(reading, CYCLE * number) for number, reading in enumerate(readings)]
    assert [grip.stop for grip in grips] == [True, False, True, False]


def test_who_stands_still_begins_anew_and_the_speed_is_that_of_now() -> None:
    gate = HoldGate()
    gate.take(NEUTRAL, 0.0)
    for number, speed in enumerate((0.2, 0.0, 1.0), start=1):
        grip = gate.take(Hand(insert=True, speed=speed), number * 0.99 * LONGEST_GAP)
        assert (grip.held, grip.speed) == (Held.INSERT, speed)
    frozen = gate.take(INSERT, 4.1 * LONGEST_GAP)
    assert (frozen.held, frozen.unheeded) == (Held.NOTHING, True)


def joystick(publishers: int = 1) -> JoySource:
    return JoySource(CONTROLS, lambda: 0.5, lambda: publishers)


def test_the_last_message_of_a_joystick_counts_while_it_is_fresh() -> None:
    source = joystick()
    assert isinstance(source.read(0.0), Lost)
    source.take([0.0, 1.0], [1, 0, 0], 5.0)
    assert source.read(5.0 + 0.999 * LONGEST_SILENCE) == Hand(insert=True, speed=0.5)
    silent = source.read(5.0 + 1.001 * LONGEST_SILENCE)
    assert silent == Lost("no message of the joystick for more than 0.1 s")
    source.take([0.0, 0.5], [0, 1, 1], 6.0)
    assert source.read(6.0) == Hand(retract=True, speed=0.25)


def test_a_message_that_was_overtaken_does_not_count_and_keeps_nothing_alive() -> None:
    source = joystick()
    source.take([0.0, 1.0], [1, 0, 0], 5.00, stamp=100.00)
    source.take([0.0, 1.0], [0, 0, 0], 5.05, stamp=99.98)
    assert source.read(5.05) == Hand(insert=True, speed=0.5)
    assert isinstance(source.read(5.00 + 1.001 * LONGEST_SILENCE), Lost)
    # A sender whose clock was set back is heard again after a silence, and one without at once.
    source.take([0.0, 1.0], [0, 0, 0], 5.11, stamp=40.00)
    assert source.read(5.11) == Hand(speed=0.5)
    source.take([0.0, 1.0], [1, 0, 0], 5.13)
    assert source.read(5.13) == Hand(insert=True, speed=0.5)


def test_a_message_that_cannot_be_meant_is_no_hand() -> None:
    for publishers, axes, buttons, why in NO_HANDS:
        source = joystick(publishers)
        source.take(axes, buttons, 5.0)
        read = source.read(5.0)
        assert isinstance(read, Lost)
        assert why in read.why
