"""SDO client: frames as canopen's, late responses, heartbeat during a transfer."""

from __future__ import annotations

import itertools

import pytest

from needle_core.can_frame import CanErrors, CanFrame
from needle_device_driver.axes.link import DriveError
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.object_access import ObjectAccess
from needle_device_driver.link.objects import DEVICE_TYPE
from needle_device_driver.link.sdo_client import SdoAbortedError, SdoClient, SdoTimeoutError
from needle_device_driver.procedure import Procedure, T, run

READ_MODES = "4002650000000000"
MODES = "43026500a1000000"


def at_once(procedure: Procedure[T]) -> T:
    return run(procedure, lambda until, _: until(), itertools.count().__next__)


class Wire:
    """Answers each request with given frames."""

    def __init__(self, *answers: str) -> None:
        self.answers = list(answers)
        self.sent: list[str] = []
        self.beats = 0
        self.client = SdoClient(1, self.send, self.beat, 0.001)
        self.on_beat = ""

    def beat(self) -> None:
        self.beats += 1
        if self.beats == 5:
            self.answer(self.on_beat)

    def answer(self, frames: str) -> None:
        for frame in frames.split():
            self.client.receive(bytes.fromhex(frame))

    def send(self, cob_id: int, data: bytes) -> None:
        assert cob_id == 0x601
        self.sent.append(data.hex())
        self.answer(self.answers.pop(0) if self.answers else "")

    def upload(self, index: int, subindex: int = 0) -> bytes:
        return at_once(self.client.upload(index, subindex))


def test_only_the_response_to_the_request_counts() -> None:
    for late in (
        # Responses to an earlier request, for another subindex, to a write request.
        "4300100092010200",
        "8000100000000206",
        "4302650100000000",
        "6002650000000000",
    ):
        assert Wire(f"{late} {MODES}").upload(0x6502) == b"\xa1\0\0\0"


def test_text_is_read_in_segments() -> None:
    first, second = "0041424344454647", "1d48000000000000"
    wire = Wire("4108100008000000", first, f"{first} {second}")
    assert wire.upload(0x1008) == b"ABCDEFGH"
    # The third bit of a request toggles (CiA 301).
    assert wire.sent == ["4008100000000000", "6000000000000000", "7000000000000000"]


def test_heartbeat_continues_during_a_slow_transfer() -> None:
    wire = Wire()
    wire.on_beat = MODES
    assert wire.upload(0x6502) == b"\xa1\0\0\0"
    assert (wire.beats, wire.sent) == (5, [READ_MODES])


def test_request_is_repeated_once() -> None:
    assert Wire("", MODES).upload(0x6502) == b"\xa1\0\0\0"
    wire = Wire()
    with pytest.raises(SdoTimeoutError):
        wire.upload(0x6502)
    assert wire.sent == [READ_MODES, READ_MODES, "8000000000000405"]
    # 0.5 s for each attempt.
    assert wire.beats == 1000
    # A cancelled transfer sends nothing more.
    wire = Wire()
    transfer = wire.client.upload(0x6502, 0)
    next(transfer)
    transfer.close()
    assert wire.sent == [READ_MODES]


def test_abort_is_an_error_with_its_code_and_text() -> None:
    with pytest.raises(SdoAbortedError, match="Code 0x06020000, Object does not exist") as caught:
        Wire("8002650000000206").upload(0x6502)
    assert caught.value.code == 0x0602_0000


def test_response_may_omit_unused_bytes() -> None:
    wire = Wire("4b4160003702", "60406000")
    assert wire.upload(0x6041) == b"\x37\x02"
    at_once(wire.client.download(0x6040, 0, b"\x06\x00"))


# ---- the link -----------------------------------------------------------------------------------


def test_link_counts_errors_passes_frames_and_reports_refusals() -> None:
    link = FrameLink("virtual test")
    link.open()
    received: list[tuple[bytes, float]] = []
    link.subscribe(0x181, lambda data, time: received.append((data, time)))
    link.now = 2.0
    frames = [CanFrame(0x181, b"\x01", time=1.5), CanFrame(0x181, b"\x02"), CanFrame(0x182)]
    link.receive([*frames, CanFrame(0x181, remote=True), CanErrors(2), CanErrors(0, 1)])
    assert received == [(b"\x01", 1.5), (b"\x02", 2.0)]
    assert (link.bus_errors, link.frames_received) == (3, 3)
    with pytest.raises(DriveError, match=r"does not answer.*the adapter rejects"):
        at_once(ObjectAccess(link, 1).read(DEVICE_TYPE))
