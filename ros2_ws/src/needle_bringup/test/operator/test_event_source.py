"""A pedal or joystick by the bytes that the kernel gives, played by a device of the test."""

import errno
import fcntl
import os
import struct

import pytest

from needle_bringup.operator import input_device
from needle_bringup.operator.controls import Controls
from needle_bringup.operator.event_source import OPEN_PERIOD, EventSource
from needle_bringup.operator.hand import Hand, Lost
from needle_bringup.operator.hold_gate import Held, HoldGate
from needle_bringup.operator.input_device import InputDevice, set_bits
from needle_bringup.operator.input_events import EventReader, KeyChanges

KEY, RETRACT, STOP, AXIS = 48, 46, 30, 2
CONTROLS = Controls(insert=KEY, retract=RETRACT, stop=STOP)
CYCLE = 0.02


def event(kind: int, code: int, value: int) -> bytes:
    """The bytes of <linux/input.h>'s struct input_event, written by hand."""
    return struct.pack("<qqHHi", 1_700_000_000, 123_456, kind, code, value)


def key(code: int, value: int) -> bytes:
    return event(1, code, value) + event(0, 0, 0)


class PlayedDevice:
    """Keeps the state of its keys, as the kernel does; sends what was done since the last look."""

    def __init__(self) -> None:
        self.keys = frozenset({KEY, RETRACT, STOP})
        self.down: set[int] = set()
        self.sent = b""
        self.axis_at = 0.0
        self.gone: int | None = None
        self.closed = False

    def do(self, code: int, value: int) -> None:
        self.sent += key(code, value)
        if value == 1:
            self.down.add(code)
        elif value == 0:
            self.down.discard(code)

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


class Desk:
    """A source, the device before it, and a gate behind it."""

    def __init__(self, controls: Controls = CONTROLS) -> None:
        self.device: PlayedDevice | None = PlayedDevice()
        self.scale = 1.0
        self.source = EventSource("/dev/input/pedal", controls, lambda: self.scale, self.open)
        self.gate = HoldGate()
        self.now = 10.0

    def open(self, path: str) -> PlayedDevice:
        assert path == "/dev/input/pedal"
        if self.device is None:
            raise FileNotFoundError(errno.ENOENT, "No such file or directory")
        return self.device

    def read(self) -> Hand | Lost:
        self.now += CYCLE
        return self.source.read(self.now)

    def held(self) -> Held:
        return self.gate.take(self.read(), self.now).held


def test_a_pedal_that_is_held_sends_nothing_and_is_held() -> None:
    desk = Desk()
    assert desk.read() == Hand()
    assert desk.device is not None
    desk.device.do(KEY, 1)
    for _ in range(100):
        assert desk.read() == Hand(insert=True)
    desk.device.do(KEY, 0)
    assert desk.read() == Hand()


def test_key_repeat_is_no_press() -> None:
    desk = Desk()
    desk.read()
    assert desk.device is not None
    desk.device.do(KEY, 2)
    desk.device.do(STOP, 2)
    assert desk.read() == Hand()


def test_what_is_down_at_the_start_counts_only_when_pressed_again() -> None:
    desk = Desk()
    assert desk.device is not None
    desk.device.down.add(KEY)
    for _ in range(5):
        assert desk.held() is Held.NOTHING
        desk.device.do(KEY, 2)
    desk.device.do(KEY, 0)
    assert desk.held() is Held.NOTHING
    desk.device.do(KEY, 1)
    assert desk.held() is Held.INSERT


def test_a_release_between_two_looks_is_seen() -> None:
    desk = Desk()
    desk.read()
    assert desk.device is not None
    desk.device.do(KEY, 1)
    assert desk.read() == Hand(insert=True)
    desk.device.do(KEY, 0)
    desk.device.do(KEY, 1)
    assert desk.read() == Hand()
    assert desk.read() == Hand(insert=True)


def test_a_stop_that_is_only_tapped_is_one() -> None:
    desk = Desk()
    desk.read()
    assert desk.device is not None
    desk.device.do(STOP, 1)
    desk.device.do(STOP, 0)
    assert desk.read() == Hand(stop=True)
    assert desk.read() == Hand()


def test_events_that_the_kernel_dropped_may_have_been_a_release() -> None:
    desk = Desk()
    desk.read()
    assert desk.device is not None
    desk.device.do(KEY, 1)
    desk.read()
    desk.device.sent += event(0, 3, 0)
    assert desk.read() == Hand()
    assert desk.read() == Hand(insert=True)


@pytest.mark.parametrize("gone", [errno.ENODEV, errno.EIO])
def test_an_unplugged_pedal_is_lost_at_once_and_pressed_anew_when_it_is_back(gone: int) -> None:
    desk = Desk()
    desk.held()
    old = desk.device
    assert old is not None
    old.do(KEY, 1)
    assert desk.held() is Held.INSERT
    # What was cut off with its plug begins no event of the next.
    old.sent = key(KEY, 1)[:10]
    desk.read()
    old.gone = gone
    desk.device = None
    assert desk.read() == Lost(f"/dev/input/pedal: {os.strerror(gone)}")
    assert old.closed
    desk.device = PlayedDevice()
    desk.device.down.add(KEY)
    lost_until = desk.now + OPEN_PERIOD
    while desk.now + CYCLE < lost_until:
        assert desk.held() is Held.NOTHING
    for _ in range(20):
        assert desk.held() is Held.NOTHING
    assert desk.read() == Hand(insert=True)
    desk.device.do(KEY, 0)
    desk.device.do(KEY, 1)
    assert desk.read() == Hand()
    desk.device.do(KEY, 0)
    assert desk.held() is Held.NOTHING
    desk.device.do(KEY, 1)
    assert desk.held() is Held.INSERT


def test_a_device_that_is_not_there_is_looked_for_now_and_then() -> None:
    desk = Desk()
    device, desk.device = desk.device, None
    assert desk.read() == Lost("/dev/input/pedal: No such file or directory")
    desk.device = device
    assert isinstance(desk.read(), Lost)
    desk.now += OPEN_PERIOD
    assert desk.read() == Hand()


def test_a_device_without_the_key_says_which_it_has() -> None:
    desk = Desk(Controls(insert=57))
    assert desk.read() == Lost("/dev/input/pedal: it has no key 57 (its keys: 30, 46, 48)")
    assert desk.device is not None
    assert desk.device.closed


def test_an_axis_sets_the_speed_up_to_the_scale() -> None:
    desk = Desk(Controls(insert=KEY, speed_axis=AXIS, axis_at_zero=0.5, axis_at_full=-1.0))
    assert desk.device is not None
    desk.scale = 0.8
    for at, share in ((1.0, 0.0), (0.5, 0.0), (-0.25, 0.5), (-1.0, 1.0)):
        desk.device.axis_at = at
        read = desk.read()
        assert isinstance(read, Hand)
        assert read.speed == pytest.approx(0.8 * share)


def test_bytes_may_be_cut_anywhere() -> None:
    whole = key(KEY, 1) + key(RETRACT, 2) + key(KEY, 0) + key(STOP, 1)
    assert EventReader().take(whole) == KeyChanges(frozenset({KEY, STOP}), frozenset({KEY}))
    for cut in range(len(whole)):
        reader = EventReader()
        one, two = reader.take(whole[:cut]), reader.take(whole[cut:])
        assert one.pressed | two.pressed == {KEY, STOP}
        assert one.released | two.released == {KEY}


def test_the_ioctls_are_those_of_the_kernels_header() -> None:
    # As a C program prints them that includes <linux/input.h>.
    assert input_device.EVIOCGKEY == 0x80604518
    assert input_device.EVIOCGBIT_KEY == 0x80604521
    assert input_device.eviocgabs(3) == 0x80184543


def test_bits_are_numbered_from_the_lowest_of_the_first_byte() -> None:
    assert set_bits(bytes([0b1, 0, 0b10000010])) == {0, 17, 23}


def test_a_file_that_is_no_input_device_is_refused() -> None:
    with pytest.raises(OSError, match="no input device"):
        InputDevice("/dev/null")
    with pytest.raises(FileNotFoundError):
        InputDevice("/dev/input/that_is_not_there")


def test_an_open_device_is_asked_as_the_kernel_wants_it(monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert device.axis(AXIS) == pytest.approx(2.0 * 192.0 / 255.0 - 1.0)
    assert asked == [0x80604521, 0x80604518, 0x80184542]
    assert device.read() == b""
    os.write(theirs, key(KEY, 1))
    assert device.read() == key(KEY, 1)
    os.close(theirs)
    os.close(ours)
    with pytest.raises(OSError, match="No such device"):
        device.read()
    device.close()
