"""The bytes of the adapter, according to the LAWICEL protocol."""

from __future__ import annotations

import pytest

from needle_core.can_frame import CanFrame
from needle_sim.bus.slcan_adapter import SlcanAdapter


@pytest.fixture
def adapter() -> SlcanAdapter:
    adapter = SlcanAdapter()
    assert adapter.feed(b"C\rS6\rO\r").reply == b"\r\r\r"
    return adapter


def test_frames_are_received_whole_or_byte_by_byte(adapter: SlcanAdapter) -> None:
    for command, frame in (
        (b"t0800\r", CanFrame(0x080)),
        (b"t20130F0008\r", CanFrame(0x201, b"\x0f\x00\x08")),
        (b"t7FF8FFFFFFFFFFFFFFFF\r", CanFrame(0x7FF, b"\xff" * 8)),
        (b"r1812\r", CanFrame(0x181, b"", remote=True)),
    ):
        taken = adapter.feed(command)
        assert (taken.reply, taken.frames) == (b"z\r", (frame,))
        in_pieces = [adapter.feed(bytes([byte])).frames for byte in command]
        assert in_pieces == [()] * (len(command) - 1) + [(frame,)]
    # The drives ignore 29-bit identifiers.
    assert adapter.feed(b"T000002010\r").reply == b"Z\r"


def test_malformed_frames_are_rejected_and_noise_is_dropped(adapter: SlcanAdapter) -> None:
    refused = (
        b"t08\r",
        b"t2013AABB\r",
        b"tXYZ0\r",
        b"t9999\r",
        b"t8000\r",
        b"t20190011223344556677\r",
        b"O\r",
        b"S6\r",
        b"\xff" * 200,
    )
    for command in refused:
        taken = adapter.feed(command)
        assert (taken.reply, taken.frames) == (b"\a", ()), command
    assert adapter.feed(b"t0800\r").frames == (CanFrame(0x080),)


def test_a_closed_channel_passes_nothing() -> None:
    adapter = SlcanAdapter()
    frame = CanFrame(0x1AB, b"\1\xab")
    assert adapter.feed(b"t0800\r").reply == b"\a"
    assert adapter.encode(frame) == b""
    adapter.feed(b"O\r")
    assert adapter.encode(frame) == b"t1AB201AB\r"
    assert adapter.encode(CanFrame(0x08F, b"")) == b"t08F0\r"
    assert adapter.feed(b"V\rN\rF\r").reply == b"V1013\rNSIM1\rF00\r"
    assert adapter.feed(b"C\r").closed
    assert adapter.encode(frame) == b""
