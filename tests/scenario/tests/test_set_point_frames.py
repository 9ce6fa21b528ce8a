"""Set-points read off frames, beside python's own struct."""

from __future__ import annotations

import struct

import pytest

from scenario.judging.set_point_frames import SetPointFrames

OPERATE, QUICK_STOP, CYCLIC, HOMING = 0x0F, 0x02, 8, 6


@pytest.fixture
def frames() -> SetPointFrames:
    return SetPointFrames({1: 2e7, 2: 1e4})


def control(word: int, mode: int) -> bytes:
    return struct.pack("<Hb", word, mode)


def test_a_drive_that_operates_goes_where_it_is_told(frames: SetPointFrames) -> None:
    assert frames.take(0x202, control(OPERATE, CYCLIC)) is None
    assert frames.take(0x302, struct.pack("<i", -12_345)) == (2, -1.2345)
    assert frames.take(0x301, struct.pack("<i", 20_000)) == (1, None), "the other does not operate"


@pytest.mark.parametrize("word_and_mode", [(QUICK_STOP, CYCLIC), (OPERATE, HOMING)])
def test_another_goes_nowhere(frames: SetPointFrames, word_and_mode: tuple[int, int]) -> None:
    frames.take(0x201, control(OPERATE, CYCLIC))
    assert frames.take(0x201, control(*word_and_mode)) == (1, None)
    assert frames.take(0x301, struct.pack("<i", 20_000)) == (1, None)


@pytest.mark.parametrize("identifier", [0x80, 0x181, 0x303, 0x601, 0x701])
def test_other_frames_say_nothing(frames: SetPointFrames, identifier: int) -> None:
    frames.take(0x201, control(OPERATE, CYCLIC))
    assert frames.take(identifier, bytes(8)) is None
