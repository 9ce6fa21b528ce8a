"""Pedal or joystick as bytes from the kernel, sent by a simulated device."""

from __future__ import annotations

import dataclasses
import errno
import fcntl
import os
import struct
from typing import Any

import pytest

from needle_bringup.operator import input_device
from needle_bringup.operator.hold_debouncer import (
    HoldDebouncer,
    HoldKind,
    InputLost,
    InputReading,
    InputState,
)
from needle_bringup.operator.input_device import InputDevice, set_bits
from needle_bringup.operator.input_port import OPEN_PERIOD, InputPort
from needle_bringup.operator.parameters import OperatorParameters

KEY, RETRACT, STOP, AXIS = 48, 46, 30, 2
PEDAL = OperatorParameters(
    device="/dev/input/pedal", key=KEY, retract_key=RETRACT, stop_key=STOP, speed_scale=0.8
)
CYCLE = 0.02
UP, DOWN, REPEAT = 0, 1, 2


def event(kind: int, code: int, value: int) -> bytes:
    """Return the bytes of struct input_event of <linux/input.h>, packed by hand."""
    return struct.pack("<qqHHi", 1_700_000_000, 123_456, kind, code, value)


def key(code: int, value: int) -> bytes:
    return event(1, code, value) + event(0, 0, 0)


class PlayedDevice(InputDevice):
    """Device that keeps the state of its keys as the kernel does, and sends pending events."""

    def __init__(self, *down: int) -> None:
        self.keys = frozenset({KEY, RETRACT, STOP})
        self.down = set(down)
        self.sent = b""
        self.axis_at = 0.0
        self.gone: int | None = None
        self.closed = False

    def read(self) -> bytes:
        self._check()
        data, self.sent = self.sent, b""
        return data

    def keys_down(self) -> frozenset[int]:
        self._check()
        return frozenset(self.down)

    def axis(self, code: int) -> float:
        assert code == AXIS
        return self.axis_at

    def close(self) -> None:
        self.closed = True

    def _check(self) -> None:
        if self.gone is not None:
            raise OSError(self.gone, os.strerror(self.gone))


class PedalPort:
    """Port with a simulated device and a debouncer."""

    def __init__(self, *down: int, **settings: Any) -> None:
        self.device = PlayedDevice(*down)
        self.is_there = True
        self.port = InputPort(dataclasses.replace(PEDAL, **settings), self.open)
        self.debouncer = HoldDebouncer()
        self.now = 10.0

    def open(self, path: str) -> PlayedDevice:
        assert path == "/dev/input/pedal"
        if not self.is_there:
            raise FileNotFoundError(errno.ENOENT, "No such file or directory")
        return self.device

    def do(self, code: int, *values: int) -> None:
        for value in values:
            self.device.sent += key(code, value)
            (self.device.down.discard if value == UP else self.device.down.add)(code)

    def read(self) -> InputReading:
        self.now += CYCLE
        return self.port.read(self.now)

    def hold(self) -> HoldKind:
        return self.debouncer.update(self.read(), self.now).kind


HOLD, STOPPED, NOTHING = (
    InputState(insert=True, speed=0.8),
    InputState(stop=True, speed=0.8),
    InputState(speed=0.8),
)
# Events before each reading, and the expected reading.
READINGS: tuple[tuple[tuple[tuple[int, ...], InputState], ...], ...] = (
    # A held pedal sends nothing.
    (((KEY, DOWN), HOLD), ((), HOLD), ((KEY, UP), NOTHING)),
    # Key repeat is not a press.
    (((KEY, REPEAT, UP), NOTHING), ((STOP, REPEAT, UP), NOTHING)),
    # A release between two readings is detected.
    (((KEY, DOWN), HOLD), ((KEY, UP, DOWN), NOTHING), ((), HOLD)),
    # A short tap of the stop counts.
    (((STOP, DOWN, UP), STOPPED), ((), NOTHING)),
)


def test_a_reading_ignores_key_repeat() -> None:
    for readings in READINGS:
        pedal = PedalPort()
        assert pedal.read() == NOTHING
        for done, wanted in readings:
            if done:
                pedal.do(*done)
            assert pedal.read() == wanted


def test_a_key_down_at_the_start_must_be_pressed_again() -> None:
    pedal = PedalPort(KEY)
    for _ in range(5):
        assert pedal.hold() is HoldKind.NOTHING
        pedal.do(KEY, REPEAT)
    pedal.do(KEY, UP)
    assert pedal.hold() is HoldKind.NOTHING
    pedal.do(KEY, DOWN)
    assert pedal.hold() is HoldKind.INSERT


def test_events_dropped_by_the_kernel_may_include_a_release() -> None:
    pedal = PedalPort()
    pedal.read()
    pedal.do(KEY, DOWN)
    pedal.read()
    pedal.device.sent += event(0, 3, 0)
    assert pedal.read() == NOTHING
    assert pedal.read() == HOLD


def test_an_unplugged_pedal_is_lost_and_must_be_pressed_again() -> None:
    pedal = PedalPort()
    pedal.hold()
    old = pedal.device
    pedal.do(KEY, DOWN)
    assert pedal.hold() is HoldKind.INSERT
    old.gone, pedal.is_there = errno.ENODEV, False
    assert pedal.read() == InputLost(f"/dev/input/pedal: {os.strerror(errno.ENODEV)}")
    assert old.closed
    pedal.device, pedal.is_there = PlayedDevice(KEY), True
    # The port searches for it periodically.
    lost_until = pedal.now + OPEN_PERIOD
    while pedal.now + CYCLE < lost_until:
        assert isinstance(pedal.read(), InputLost)
    for _ in range(5):
        assert pedal.hold() is HoldKind.NOTHING
    assert pedal.read() == HOLD
    pedal.do(KEY, UP)
    assert pedal.hold() is HoldKind.NOTHING
    pedal.do(KEY, DOWN)
    assert pedal.hold() is HoldKind.INSERT


def test_a_missing_device_or_key_is_named() -> None:
    pedal = PedalPort()
    pedal.is_there = False
    assert pedal.read() == InputLost("/dev/input/pedal: No such file or directory")
    pedal = PedalPort(key=57)
    assert pedal.read() == InputLost("/dev/input/pedal: it has no key 57 (its keys: 30, 46, 48)")
    assert pedal.device.closed


def test_an_axis_sets_the_speed_up_to_the_scale() -> None:
    axis = {"speed_axis": AXIS, "axis_at_zero": 0.5, "axis_at_full": -1.0}
    pedal = PedalPort(source="joystick", **axis)
    for at, share in ((1.0, 0.0), (0.5, 0.0), (-0.25, 0.5), (-1.0, 1.0)):
        pedal.device.axis_at = at
        read = pedal.read()
        assert isinstance(read, InputState)
        assert read.speed == pytest.approx(0.8 * share)


def test_a_file_that_is_not_an_input_device_is_rejected() -> None:
    with pytest.raises(OSError, match="no input device"):
        InputDevice("/dev/null")


def test_ioctls_of_an_input_device(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def answer(file: int, request: int, data: bytes) -> bytes:
        asked.append(request)
        assert len(data) == request >> 16 & 0x3FFF
        if request >> 8 & 0xFF == ord("E") and request & 0xFF >= 0x40:
            return struct.pack("=6i", 192, 0, 255, 0, 15, 0)
        return bytes([0, 0b100]) + bytes(94)

    monkeypatch.setattr(fcntl, "ioctl", answer)
    ours, theirs = os.pipe()
    device = InputDevice(f"/proc/self/fd/{ours}")
    assert device.keys == {10}
    assert device.keys_down() == {10}
    assert set_bits(bytes([0b1, 0, 0b10000010])) == {0, 17, 23}
    assert device.axis(AXIS) == pytest.approx(2.0 * 192.0 / 255.0 - 1.0)
    # Values printed by a C program that includes <linux/input.h>.
    assert asked == [0x80604521, 0x80604518, 0x80184542]
    assert input_device.eviocgabs(3) == 0x80184543
    assert device.read() == b""
    os.write(theirs, key(KEY, DOWN))
    assert device.read() == key(KEY, DOWN)
    os.close(theirs)
    os.close(ours)
    with pytest.raises(OSError, match="No such device"):
        device.read()
    device.close()
