"""The adapter's bytes, as the LAWICEL protocol has them."""

from __future__ import annotations

import pytest

from needle_core.can_frame import CanFrame
from needle_sim.bus.slcan_adapter import SlcanAdapter


@pytest.fixture
def adapter() -> SlcanAdapter:
    adapter = SlcanAdapter()
    assert adapter.feed(b"C\rS6\rO\r").reply == b"\r\r\r"
    return adapter


@pytest.mark.parametrize(
    ("command", "frame"),
    [
        (b"t0800\r", CanFrame(0x080)),
        (b"t60184060100200000000\r", None),
        (b"t20130F0008\r", CanFrame(0x201, b"\x0f\x00\x08")),
        (b"t7FF8FFFFFFFFFFFFFFFF\r", CanFrame(0x7FF, b"\xff" * 8)),
        (b"r1812\r", CanFrame(0x181, b"", remote=True)),
    ],
)
def test_takes_frames(adapter: SlcanAdapter, command: bytes, frame: CanFrame | None) -> None:
    taken = adapter.feed(command)
    assert taken.reply == b"z\r"
    assert len(taken.frames) == 1
    if frame is not None:
        assert taken.frames == (frame,)


@pytest.mark.parametrize(
    "command",
    [b"t08\r", b"t2013AABB\r", b"tXYZ0\r", b"t9999\r", b"t20190011223344556677\r", b"O\r", b"S6\r"],
)
def test_refuses_what_is_no_frame(adapter: SlcanAdapter, command: bytes) -> None:
    taken = adapter.feed(command)
    assert (taken.reply, taken.frames) == (b"\a", ())


def test_bytes_may_come_in_pieces(adapter: SlcanAdapter) -> None:
    frames: list[CanFrame] = []
    for byte in b"t2012ABCD\rt0800\r":
        frames += adapter.feed(bytes([byte])).frames
    assert frames == [CanFrame(0x201, b"\xab\xcd"), CanFrame(0x080)]


def test_noise_is_thrown_away(adapter: SlcanAdapter) -> None:
    assert adapter.feed(b"\xff" * 200).reply == b"\a"
    assert adapter.feed(b"t0800\r").frames == (CanFrame(0x080),)


def test_closed_channel_passes_nothing() -> None:
    adapter = SlcanAdapter()
    assert adapter.feed(b"t0800\r").reply == b"\a"
    assert adapter.encode(CanFrame(0x181, b"\1")) == b""
    adapter.feed(b"O\r")
    assert adapter.encode(CanFrame(0x1AB, b"\1\xab")) == b"t1AB201AB\r"
    assert adapter.encode(CanFrame(0x08F, b"")) == b"t08F0\r"
    assert adapter.feed(b"V\rN\rF\r").reply == b"V1013\rNSIM1\rF00\r"
    adapter.feed(b"C\r")
    assert not adapter._open
