"""Accepted presses, compared with a rule on the whole history; time-outs of a joystick."""

from __future__ import annotations

import math

from hypothesis import given, settings
from hypothesis import strategies as st

from needle_bringup.operator.hold_debouncer import (
    MAX_GAP,
    HoldDebouncer,
    HoldKind,
    InputLost,
    InputReading,
    InputState,
)
from needle_bringup.operator.joy_source import JOY_TIMEOUT, JoySource
from needle_bringup.operator.parameters import OperatorParameters

CYCLE = 0.02
INSERT, RETRACT, NEUTRAL = InputState(insert=True), InputState(retract=True), InputState()
WANTS: dict[InputReading, HoldKind] = {INSERT: HoldKind.INSERT, RETRACT: HoldKind.RETRACT}
BOTH, STOPPED = InputState(insert=True, retract=True), InputState(insert=True, stop=True)
READINGS = (NEUTRAL, INSERT, RETRACT, BOTH, InputState(stop=True), STOPPED, InputLost("unplugged"))
moments = st.tuples(st.sampled_from(READINGS), st.sampled_from((CYCLE, CYCLE, CYCLE, 0.15)))
JOYSTICK = OperatorParameters("joy", key=0, retract_key=2, speed_axis=1, axis_at_zero=0.0)

INVALID_JOY_MESSAGES: tuple[tuple[int, list[float], list[int], str], ...] = (
    (2, [0.0, 1.0], [1, 0, 0], "2 nodes publish"),
    (1, [0.0, 1.0], [1, 0], "has 2 buttons, but no 2"),
    (1, [0.0], [1, 0, 0], "has 1 axes, but no 1"),
    (1, [0.0, math.nan], [1, 0, 0], "axis 1 is nan"),
)


def counts(seen: list[tuple[InputReading, float]]) -> HoldKind:
    """Return the hold allowed at the end of the history: a button pressed alone since neutral."""
    last = seen[-1][0]
    for reading, gap in reversed(seen):
        if reading == NEUTRAL:
            return WANTS.get(last, HoldKind.NOTHING)
        if reading != last or last not in WANTS or gap > MAX_GAP:
            break
    return HoldKind.NOTHING


def stops(reading: InputReading) -> bool:
    return isinstance(reading, InputState) and reading.stop


@settings(max_examples=60, deadline=None)
@given(st.lists(moments, min_size=1, max_size=30))
def test_only_a_new_press_is_accepted(seen: list[tuple[InputReading, float]]) -> None:
    debouncer, now = HoldDebouncer(), 0.0
    # There is no gap before the first reading.
    seen[0] = (seen[0][0], 0.0)
    for number, (reading, gap) in enumerate(seen):
        now += gap
        decision = debouncer.update(reading, now)
        assert decision.kind is counts(seen[: number + 1])
        assert bool(decision.problem) is isinstance(reading, InputLost)
        stopped_before = number > 0 and stops(seen[number - 1][0])
        assert decision.stop is (stops(reading) and not stopped_before)


class Joystick(JoySource):
    """Source for a joystick at half speed."""

    def __init__(self) -> None:
        super().__init__(JOYSTICK)

    def reading(self, now: float, publishers: int = 1) -> InputReading:
        return self.read(now, 0.5, publishers)


def test_the_last_message_of_a_joystick_is_used_while_recent() -> None:
    source = Joystick()
    assert isinstance(source.reading(0.0), InputLost)
    source.receive([0.0, 1.0], [1, 0, 0], 5.0)
    assert source.reading(5.0 + 0.999 * JOY_TIMEOUT) == InputState(insert=True, speed=0.5)
    silent = source.reading(5.0 + 1.001 * JOY_TIMEOUT)
    assert silent == InputLost("no message from the joystick for more than 0.1 s")
    source.receive([0.0, 0.5], [0, 1, 1], 6.0)
    assert source.reading(6.0) == InputState(retract=True, speed=0.25)


def test_an_overtaken_message_is_ignored() -> None:
    source = Joystick()
    source.receive([0.0, 1.0], [1, 0, 0], 5.00, stamp=100.00)
    source.receive([0.0, 1.0], [0, 0, 0], 5.05, stamp=99.98)
    assert source.reading(5.05) == InputState(insert=True, speed=0.5)
    assert isinstance(source.reading(5.00 + 1.001 * JOY_TIMEOUT), InputLost)
    # A sender whose clock was set back is accepted after a silence; without stamps, at once.
    source.receive([0.0, 1.0], [0, 0, 0], 5.11, stamp=40.00)
    assert source.reading(5.11) == InputState(speed=0.5)
    source.receive([0.0, 1.0], [1, 0, 0], 5.13)
    assert source.reading(5.13) == InputState(insert=True, speed=0.5)


def test_an_invalid_message_is_a_loss_of_the_joystick() -> None:
    for publishers, axes, buttons, why in INVALID_JOY_MESSAGES:
        source = Joystick()
        source.receive(axes, buttons, 5.0)
        read = source.reading(5.0, publishers)
        assert isinstance(read, InputLost)
        assert why in read.reason
