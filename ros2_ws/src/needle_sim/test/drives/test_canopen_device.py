"""The emulated drives as a CANopen network sees them, through PyPI canopen."""

from __future__ import annotations

import canopen
import pytest

from needle_sim.bus.object_dictionary import Abort

from .master import INSERTION, MASTER, ROTATION, Master


@pytest.fixture
def master() -> Master:
    return Master()


def test_boots_once_with_its_id_and_waits_for_start() -> None:
    master = Master()
    assert [frame.identifier for frame in master.heard[:2]] == [0x701, 0x702]
    assert master.frames(0x701)[0] == b"\0"


def test_says_what_it_is(master: Master) -> None:
    assert master.nodes[INSERTION].sdo.upload(0x1008, 0) == b"Emulated insertion drive"
    assert master.read(0x1000) == 0x00040192
    assert master.read(0x1000, node=ROTATION) == 0x00020192
    assert master.read(0x6502) == 0b10100001
    assert master.read(0x1018, 4, ROTATION) == ROTATION


@pytest.mark.parametrize(
    ("index", "subindex", "value", "size", "code"),
    [
        (0x2345, 0, 0, 1, Abort.NO_OBJECT),
        (0x6099, 9, 0, 1, Abort.NO_SUBINDEX),
        (0x6041, 0, 0, 2, Abort.READ_ONLY),
        (0x6040, 0, 0, 4, Abort.WRONG_LENGTH),
        (0x6060, 0, 3, 1, Abort.VALUE_RANGE),
        (0x6098, 0, 1, 1, Abort.VALUE_RANGE),
        (0x1A00, 1, 0x60640020, 4, Abort.DEVICE_STATE),
        (0x1800, 1, 0x00000999, 4, Abort.VALUE_RANGE),
    ],
)
def test_refuses_with_the_code_of_the_standard(
    master: Master, index: int, subindex: int, value: int, size: int, code: Abort
) -> None:
    with pytest.raises(canopen.SdoAbortedError) as refused:
        master.write(index, subindex, value, size)
    assert refused.value.code == code


def test_takes_values_in_segments_too(master: Master) -> None:
    with master.nodes[INSERTION].sdo.open(0x6081, 0, "wb", size=4, force_segment=True) as entry:
        entry.write((4711).to_bytes(4, "little"))
    assert master.read(0x6081) == 4711


def test_is_silent_to_block_transfer_but_for_an_abort(master: Master) -> None:
    with pytest.raises(canopen.SdoAbortedError) as refused:
        master.nodes[INSERTION].sdo.open(0x1008, 0, "rb", block_transfer=True).read()
    assert refused.value.code == Abort.COMMAND


def remap(master: Master, number: int, entries: list[int], kind: int, base: int = 0x1800) -> None:
    mapping = base + 0x200 + number
    cob_id = master.read(base + number, 1) & 0x7FF
    master.write(base + number, 1, 1 << 31 | cob_id, 4)
    master.write(mapping, 0, 0, 1)
    for k, entry in enumerate(entries):
        master.write(mapping, k + 1, entry, 4)
    master.write(mapping, 0, len(entries), 1)
    master.write(base + number, 2, kind, 1)
    master.write(base + number, 1, cob_id, 4)


def test_sends_what_is_mapped_with_every_nth_sync(master: Master) -> None:
    remap(master, 1, [0x60640020, 0x60410010], 2)
    master.heard.clear()
    master.sync(5)
    sent = master.frames(0x281)
    assert len(sent) == 2
    assert sent[0] == bytes(4) + master.status().to_bytes(2, "little")


def test_sends_on_change_and_by_the_event_timer(master: Master) -> None:
    assert len(master.frames(0x181)) == 1  # default: statusword on change
    master.heard.clear()
    master.wait(0.2)
    assert master.frames(0x181) == []
    master.control(0x06)
    assert master.frames(0x181) == [master.status().to_bytes(2, "little")]
    master.write(0x1800, 5, 50, 2)
    master.heard.clear()
    master.wait(0.2)
    assert len(master.frames(0x181)) in (3, 4)


def test_answers_a_remote_request(master: Master) -> None:
    master.heard.clear()
    master.network.send_message(0x181, b"", remote=True)
    assert master.frames(0x181) == [master.status().to_bytes(2, "little")]


def test_applies_a_synchronous_pdo_with_the_sync_only(master: Master) -> None:
    remap(master, 1, [0x607A0020], 1, base=0x1400)
    remap(master, 2, [0x60810020], 255, base=0x1400)
    master.network.send_message(0x301, (77).to_bytes(4, "little"))
    master.network.send_message(0x401, (88).to_bytes(4, "little"))
    assert master.read(0x607A) == 0
    assert master.read(0x6081) == 88
    master.sync()
    assert master.read(0x607A) == 77
    # Too short to hold all that is mapped: not taken at all.
    master.network.send_message(0x401, b"\1\0")
    assert master.read(0x6081) == 88


@pytest.mark.parametrize(
    ("entries", "code"),
    [
        ([0x60640020, 0x607A0020, 0x60410010], Abort.MAPPING_TOO_LONG),
        ([0x10000020], Abort.NOT_MAPPABLE),
        ([0x60640010], Abort.NOT_MAPPABLE),
        ([0x23450020], Abort.NO_OBJECT),
    ],
)
def test_refuses_a_mapping_that_cannot_be(master: Master, entries: list[int], code: Abort) -> None:
    with pytest.raises(canopen.SdoAbortedError) as refused:
        remap(master, 1, entries, 1)
    assert refused.value.code == code


def test_has_no_process_data_unless_operational(master: Master) -> None:
    remap(master, 1, [0x60640020], 1)
    master.network.nmt.send_command(0x80)
    master.heard.clear()
    master.sync(3)
    assert master.heard == []
    master.network.nmt.send_command(0x02)
    with pytest.raises(canopen.SdoCommunicationError):
        master.nodes[INSERTION].sdo.RESPONSE_TIMEOUT = 0.001
        master.read(0x1000)


def test_heartbeat_comes_at_its_period_and_with_the_state(master: Master) -> None:
    master.write(0x1017, 0, 30, 2)
    master.heard.clear()
    master.wait(0.3)
    beats = master.frames(0x701)
    assert len(beats) in (9, 10, 11)
    assert set(beats) == {b"\5"}
    assert master.nodes[INSERTION].nmt.state == "OPERATIONAL"


def test_lost_heartbeat_of_the_master_is_an_emergency_and_a_fault(master: Master) -> None:
    master.enable(8)
    master.write(0x1016, 1, MASTER << 16 | 100, 4)
    # Monitoring begins with the first heartbeat.
    master.wait(0.5)
    assert master.state() == 0x27
    for _ in range(10):
        master.network.send_message(0x700 + MASTER, b"\5")
        master.wait(0.09)
    assert master.state() == 0x27
    master.heard.clear()
    master.wait(0.02)
    assert master.frames(0x81) == [bytes([0x30, 0x81, 0x11, 0, 0, 0, 0, 0])]
    assert master.read(0x603F) == 0x8130
    master.sync()
    assert master.state() == 0x08
    # 0x1029: 0 leaves OPERATIONAL.
    assert master.bus.drives["insertion"].device.state == 0x7F
    # The other drive monitors nobody.
    assert master.bus.drives["rotation"].device.state == 0x05


def test_remembers_its_errors(master: Master) -> None:
    master.bus.emergency("insertion", 0x5530)
    master.wait(0.001)
    assert master.frames(0x81) == [bytes([0x30, 0x55, 0x21, 0, 0, 0, 0, 0])]
    assert (master.read(0x1003), master.read(0x1003, 1)) == (1, 0x5530)
    assert master.read(0x1001) == 0x21
    master.write(0x1003, 0, 0, 1)
    assert master.read(0x1003) == 0


def test_reset_node_forgets_and_boots_again(master: Master) -> None:
    master.write(0x6081, 0, 4711, 4)
    master.heard.clear()
    master.network.nmt.send_command(0x81)
    master.wait(0.31)
    assert master.frames(0x701) == [b"\0"]
    assert master.read(0x6081) != 4711
