"""A joystick behind a topic: fresh, alone, and with the buttons that are wanted."""

import math

import pytest

from needle_bringup.operator.controls import Controls
from needle_bringup.operator.hand import Hand, Lost
from needle_bringup.operator.joy_source import LONGEST_SILENCE, JoySource

CONTROLS = Controls(insert=0, retract=2, speed_axis=1, axis_at_zero=0.0, axis_at_full=1.0)


class Desk:
    def __init__(self) -> None:
        self.publishers = 1
        self.source = JoySource(CONTROLS, lambda: 0.5, lambda: self.publishers)


def test_the_last_message_counts_while_it_is_fresh() -> None:
    source = Desk().source
    assert isinstance(source.read(0.0), Lost)
    source.take([0.0, 1.0], [1, 0, 0], 5.0)
    assert source.read(5.0 + 0.999 * LONGEST_SILENCE) == Hand(insert=True, speed=0.5)
    silent = source.read(5.0 + 1.001 * LONGEST_SILENCE)
    assert silent == Lost("no message of the joystick for more than 0.1 s")
    source.take([0.0, 0.5], [0, 1, 1], 6.0)
    assert source.read(6.0) == Hand(retract=True, speed=0.25)


def test_a_message_that_was_overtaken_does_not_count() -> None:
    source = Desk().source
    source.take([0.0, 1.0], [1, 0, 0], 5.00, stamp=100.00)
    source.take([0.0, 1.0], [0, 0, 0], 5.05, stamp=99.98)
    assert source.read(5.05) == Hand(insert=True, speed=0.5)
    # It keeps nothing alive either.
    assert isinstance(source.read(5.00 + 1.001 * LONGEST_SILENCE), Lost)
    # A sender whose clock was set back is heard again after a silence.
    source.take([0.0, 1.0], [0, 0, 0], 5.11, stamp=40.00)
    assert source.read(5.11) == Hand(speed=0.5)
    source.take([0.0, 1.0], [1, 0, 0], 5.13, stamp=40.02)
    assert source.read(5.13) == Hand(insert=True, speed=0.5)


def test_messages_without_a_stamp_count_as_they_come() -> None:
    source = Desk().source
    source.take([0.0, 1.0], [1, 0, 0], 5.00, stamp=100.0)
    source.take([0.0, 1.0], [0, 0, 0], 5.02)
    assert source.read(5.02) == Hand(speed=0.5)
    source.take([0.0, 1.0], [1, 0, 0], 5.04, stamp=99.0)
    assert source.read(5.04) == Hand(insert=True, speed=0.5)


def test_of_two_that_talk_in_turn_none_counts() -> None:
    desk = Desk()
    desk.source.take([0.0, 1.0], [1, 0, 0], 5.0)
    desk.publishers = 2
    assert isinstance(desk.source.read(5.0), Lost)


@pytest.mark.parametrize(
    ("axes", "buttons", "why"),
    [
        ([0.0, 1.0], [1, 0], "has 2 buttons, none 2"),
        ([0.0], [1, 0, 0], "has 1 axes, none 1"),
        ([0.0, math.nan], [1, 0, 0], "axis 1 is nan"),
        ([0.0, math.inf], [1, 0, 0], "axis 1 is inf"),
    ],
)
def test_a_message_that_cannot_be_meant_is_no_hand(
    axes: list[float], buttons: list[int], why: str
) -> None:
    source = Desk().source
    source.take(axes, buttons, 5.0)
    read = source.read(5.0)
    assert isinstance(read, Lost)
    assert why in read.why
