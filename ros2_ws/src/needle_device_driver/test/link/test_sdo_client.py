"""The SDO client: byte for byte as canopen's, late answers, and the heartbeat while it waits."""

from __future__ import annotations

import itertools
import struct
from typing import Any

import canopen
import pytest
from canopen.objectdictionary import ODVariable, datatypes
from canopen.sdo import client as canopen_client

from needle_device_driver.link import sdo_client
from needle_device_driver.link.sdo_aborts import SdoAbortedError, SdoSilenceError
from needle_device_driver.link.sdo_client import SdoClient
from needle_device_driver.procedure import Procedure, T, run

READ_MODES = bytes.fromhex("4002650000000000")
MODES = bytes.fromhex("43026500a1000000")
LATE = bytes.fromhex("4300100092010200")


class Wire:
    """Takes requests, and answers with what it was given, one list for each."""

    def __init__(self, *answers: list[bytes]) -> None:
        self.answers = list(answers)
        self.sent: list[bytes] = []
        self.beats = 0
        self.client = SdoClient(1, self.send, self.beat, 0.001)
        self.on_beat: list[bytes] = []

    def beat(self) -> None:
        self.beats += 1
        if self.beats == 5:
            self.answer(self.on_beat)

    def answer(self, answers: list[bytes]) -> None:
        for answer in answers:
            self.client.receive(answer)

    def send(self, cob_id: int, data: bytes) -> None:
        assert cob_id == 0x601
        self.sent.append(data)
        self.answer(self.answers.pop(0) if self.answers else [])

    def run(self, procedure: Procedure[T]) -> T:
        return run(procedure, lambda until, _: until(), itertools.count().__next__)

    def upload(self, index: int, subindex: int) -> bytes:
        return self.run(self.client.upload(index, subindex))

    def download(self, index: int, subindex: int, data: bytes) -> None:
        self.run(self.client.download(index, subindex, data))


def test_an_answer_to_an_earlier_request_is_not_taken_for_this_ones() -> None:
    wire = Wire([LATE, MODES])
    assert wire.upload(0x6502, 0) == b"\xa1\x00\x00\x00"
    wire = Wire([bytes.fromhex("8000100000000206"), MODES])
    assert wire.upload(0x6502, 0) == b"\xa1\x00\x00\x00"


def test_an_answer_about_another_subindex_is_not_taken_for_this_ones() -> None:
    wire = Wire([bytes.fromhex("4302650100000000"), MODES])
    assert wire.upload(0x6502, 0) == b"\xa1\x00\x00\x00"


def test_an_answer_to_another_kind_of_request_or_the_last_segment_is_none() -> None:
    written = bytes.fromhex("6002650000000000")
    wire = Wire([written, MODES])
    assert wire.upload(0x6502, 0) == b"\xa1\x00\x00\x00"
    first, second = bytes.fromhex("0041424344454647"), bytes.fromhex("1d48000000000000")
    wire = Wire([bytes.fromhex("4108100008000000")], [first], [first, second])
    assert wire.upload(0x1008, 0) == b"ABCDEFGH"


def test_the_heartbeat_goes_on_while_a_drive_takes_its_time() -> None:
    wire = Wire([])
    wire.on_beat = [MODES]
    assert wire.upload(0x6502, 0) == b"\xa1\x00\x00\x00"
    assert wire.beats == 5
    assert wire.sent == [READ_MODES]


def test_a_lost_request_is_sent_again_once_and_then_given_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sdo_client, "_RESPONSE_WAIT", 0.01)
    wire = Wire([], [MODES])
    assert wire.upload(0x6502, 0) == b"\xa1\x00\x00\x00"
    wire = Wire()
    with pytest.raises(SdoSilenceError):
        wire.upload(0x6502, 0)
    assert wire.sent == [READ_MODES, READ_MODES, bytes.fromhex("8000000000000405")]


def test_a_refusal_has_its_code() -> None:
    wire = Wire([bytes.fromhex("8002650000000206")])
    with pytest.raises(SdoAbortedError) as caught:
        wire.upload(0x6502, 0)
    assert caught.value.code == 0x0602_0000
    assert str(caught.value) == str(canopen.SdoAbortedError(0x0602_0000))


def test_an_answer_may_leave_out_the_bytes_that_it_does_not_need() -> None:
    wire = Wire([bytes.fromhex("4b416000") + b"\x37\x02"], [bytes.fromhex("60406000")])
    assert wire.upload(0x6041, 0) == b"\x37\x02"
    wire.download(0x6040, 0, b"\x06\x00")


def test_a_number_in_segments_is_put_together() -> None:
    wire = Wire([bytes.fromhex("4102650004000000")], [bytes.fromhex("07a1000000000000")])
    assert wire.upload(0x6502, 0) == b"\xa1\x00\x00\x00"


def test_a_cancelled_transfer_sends_nothing_more() -> None:
    wire = Wire()
    transfer = wire.client.upload(0x6502, 0)
    next(transfer)
    transfer.close()
    assert wire.sent == [READ_MODES]


class Server(canopen.LocalNode):
    """canopen's own server, and a bus that carries frames to it and back at once."""

    def __init__(self) -> None:
        objects = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
        entry = ODVariable("text", 0x2000, 0)
        entry.data_type = datatypes.DOMAIN
        objects.add_object(entry)
        super().__init__(1, objects)
        self.frames: list[bytes] = []
        self.receivers: list[Any] = []
        bus: Any = self
        self.sdo.network = bus

    def send_message(self, cob_id: int, data: bytes, remote: bool = False) -> None:
        self.frames.append(bytes(data))
        if cob_id == 0x581:
            for receive in self.receivers:
                receive(bytes(data))
        else:
            server: Any = self.sdo
            server.on_request(cob_id, bytearray(data), 0.0)


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 6, 7, 8, 13, 14, 15, 100])
def test_what_it_sends_and_reads_is_what_canopen_does(size: int) -> None:
    data = bytes(range(1, size + 1))
    ours, theirs = Server(), Server()
    client = SdoClient(1, ours.send_message, lambda: None, 0.001)
    ours.receivers.append(client.receive)
    run(client.download(0x2000, 0, data), lambda until, _: until(), itertools.count().__next__)
    make_client: Any = canopen_client.SdoClient
    oracle = make_client(0x601, 0x581, theirs.object_dictionary)
    oracle.network = theirs
    theirs.receivers.append(lambda frame: oracle.on_response(0x581, bytearray(frame), 0.0))
    oracle.download(0x2000, 0, data)
    assert ours.get_data(0x2000, 0) == data
    assert (
        run(client.upload(0x2000, 0), lambda until, _: until(), itertools.count().__next__) == data
    )
    assert oracle.upload(0x2000, 0) == data
    assert ours.frames == theirs.frames
    assert struct.unpack_from("<H", ours.frames[0], 1) == (0x2000,)


def test_every_abort_code_has_canopens_words() -> None:
    for code, text in canopen.SdoAbortedError.CODES.items():
        ours = str(SdoAbortedError(code))
        assert ours.startswith(f"Code 0x{code:08X}, ")
        if code < 0x0800_0000:
            assert ours.endswith(text)
    assert str(SdoAbortedError(1)) == "Code 0x00000001"
