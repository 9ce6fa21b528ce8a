"""The SDO client: late answers, and the heartbeat while it waits."""

from __future__ import annotations

from typing import Any

import canopen
import pytest

from needle_device_driver.link import sdo_client
from needle_device_driver.link.sdo_client import PatientSdoClient

READ_MODES = bytes.fromhex("4002650000000000")
MODES = bytes.fromhex("43026500a1000000")
LATE = bytes.fromhex("4300100092010200")


class Wire:
    """Takes requests, and answers with what it was given, one list for each."""

    def __init__(self, *answers: list[bytes]) -> None:
        self.answers = list(answers)
        self.sent: list[bytes] = []
        self.beats = 0
        self.client = PatientSdoClient(1, self.beat, 0.001, lambda there, _: there())
        network: Any = self
        self.client.network = network
        self.on_beat: list[bytes] = []

    def beat(self) -> None:
        self.beats += 1
        if self.beats == 5:
            self.answer(self.on_beat)

    def answer(self, answers: list[bytes]) -> None:
        for answer in answers:
            self.client.responses.put(answer)

    def send_message(self, can_id: int, data: bytes) -> None:
        assert can_id == 0x601
        self.sent.append(bytes(data))
        self.answer(self.answers.pop(0) if self.answers else [])


def test_an_answer_to_an_earlier_request_is_not_taken_for_this_ones() -> None:
    wire = Wire([LATE, MODES])
    assert wire.client.upload(0x6502, 0) == b"\xa1\x00\x00\x00"
    wire = Wire([bytes.fromhex("8000100000000206"), MODES])
    assert wire.client.upload(0x6502, 0) == b"\xa1\x00\x00\x00"


def test_the_heartbeat_goes_on_while_a_drive_takes_its_time() -> None:
    wire = Wire([])
    wire.on_beat = [MODES]
    assert wire.client.upload(0x6502, 0) == b"\xa1\x00\x00\x00"
    assert wire.beats == 5
    assert wire.sent == [READ_MODES]


def test_a_lost_request_is_sent_again_once_and_then_given_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sdo_client, "_RESPONSE_WAIT", 0.01)
    wire = Wire([], [MODES])
    assert wire.client.upload(0x6502, 0) == b"\xa1\x00\x00\x00"
    wire = Wire()
    with pytest.raises(canopen.SdoCommunicationError):
        wire.client.upload(0x6502, 0)
    assert wire.sent == [READ_MODES, READ_MODES, bytes.fromhex("8000000000000405")]


def test_a_refusal_has_its_code() -> None:
    wire = Wire([bytes.fromhex("8002650000000206")])
    with pytest.raises(canopen.SdoAbortedError) as caught:
        wire.client.upload(0x6502, 0)
    assert caught.value.code == 0x0602_0000


def test_an_answer_may_leave_out_the_bytes_that_it_does_not_need() -> None:
    wire = Wire([bytes.fromhex("4b416000") + b"\x37\x02"], [bytes.fromhex("60406000")])
    assert wire.client.upload(0x6041, 0) == b"\x37\x02"
    wire.client.download(0x6040, 0, b"\x06\x00")


def test_a_number_in_segments_is_put_together() -> None:
    wire = Wire([bytes.fromhex("4102650004000000")], [bytes.fromhex("07a1000000000000")])
    assert wire.client.upload(0x6502, 0) == b"\xa1\x00\x00\x00"
