"""The emulated drives as CANopen devices, tested with PyPI canopen."""

from __future__ import annotations

import canopen
import pytest

from needle_sim.bus.object_dictionary import Abort

from .master import INSERTION, MASTER, ROTATION, Master


def refused(master: Master, index: int, subindex: int, value: int, size: int) -> int:
    """Return the abort code of a write."""
    with pytest.raises(canopen.SdoAbortedError) as aborted:
        master.write(index, subindex, value, size)
    return int(aborted.value.code)


def remap(master: Master, number: int, entries: list[int], kind: int, base: int = 0x1800) -> None:
    """Switch a PDO off, map objects into it and switch it on again."""
    mapping = base + 0x200 + number
    cob_id = master.read(base + number, 1) & 0x7FF
    master.write(base + number, 1, 1 << 31 | cob_id, 4)
    master.write(mapping, 0, 0, 1)
    for k, entry in enumerate(entries):
        master.write(mapping, k + 1, entry, 4)
    master.write(mapping, 0, len(entries), 1)
    master.write(base + number, 2, kind, 1)
    master.write(base + number, 1, cob_id, 4)


def test_each_drive_boots_identifies_itself_and_reboots_after_a_reset(
    master: Master,
) -> None:
    assert [(frame.identifier, frame.data) for frame in master.received[:2]] == [
        (0x701, b"\0"),
        (0x702, b"\0"),
    ]
    assert master.read(0x1000) == 0x00040192
    assert master.read(0x1000, node=ROTATION) == 0x00020192
    assert master.read(0x6502) == 0b10100001
    assert master.read(0x1018, 4, ROTATION) == ROTATION
    default = master.read(0x6081)
    master.write(0x6081, 0, 4711, 4)
    master.received.clear()
    master.network.nmt.send_command(0x81)
    master.wait(0.31)
    assert master.frames(0x701) == [b"\0"]
    assert master.read(0x6081) == default != 4711


def test_writes_are_refused_with_the_code_of_the_standard(master: Master) -> None:
    for index, subindex, value, size, code in (
        (0x2345, 0, 0, 1, Abort.NO_OBJECT),
        (0x6099, 9, 0, 1, Abort.NO_SUBINDEX),
        (0x6041, 0, 0, 2, Abort.READ_ONLY),
        (0x6040, 0, 0, 4, Abort.WRONG_LENGTH),
        (0x6060, 0, 3, 1, Abort.VALUE_RANGE),
        # While the PDO is enabled.
        (0x1A00, 1, 0x60640020, 4, Abort.DEVICE_STATE),
        (0x1800, 1, 0x00000999, 4, Abort.VALUE_RANGE),
    ):
        assert refused(master, index, subindex, value, size) == code, hex(index)
    for entries, code in (
        ([0x60640020, 0x607A0020, 0x60410010], Abort.MAPPING_TOO_LONG),
        ([0x10000020], Abort.NOT_MAPPABLE),
        ([0x60640010], Abort.NOT_MAPPABLE),
        ([0x23450020], Abort.NO_OBJECT),
    ):
        with pytest.raises(canopen.SdoAbortedError) as aborted:
            remap(master, 1, entries, 1)
        assert aborted.value.code == code, entries


def test_texts_are_read_in_segments_and_other_transfers_are_rejected(master: Master) -> None:
    sdo = master.nodes[INSERTION].sdo
    assert sdo.upload(0x1008, 0) == b"Emulated insertion drive"
    with pytest.raises(canopen.SdoAbortedError) as aborted:
        sdo.open(0x1008, 0, "rb", block_transfer=True).read()
    assert aborted.value.code == Abort.COMMAND


def test_mapped_objects_are_sent_with_every_sync_and_others_on_change(master: Master) -> None:
    remap(master, 1, [0x60640020, 0x60410010], 1)
    # The default: the statusword on change.
    assert len(master.frames(0x181)) == 1
    master.received.clear()
    master.wait(0.2)
    assert master.received == []
    master.control(0x06)
    now = master.status().to_bytes(2, "little")
    master.sync(2)
    assert master.frames(0x181) == [now]
    assert master.frames(0x281) == [bytes(4) + now] * 2


def test_a_synchronous_pdo_is_applied_with_the_sync_only(master: Master) -> None:
    remap(master, 1, [0x607A0020], 1, base=0x1400)
    remap(master, 2, [0x60810020, 0x60830020], 255, base=0x1400)
    master.network.send_message(0x301, (77).to_bytes(4, "little"))
    master.network.send_message(0x401, (88).to_bytes(4, "little") + bytes(4))
    assert (master.read(0x607A), master.read(0x6081)) == (0, 88)
    master.sync()
    assert master.read(0x607A) == 77
    # A frame shorter than the mapping is ignored.
    master.network.send_message(0x401, (99).to_bytes(4, "little"))
    assert master.read(0x6081) == 88


def test_process_data_flow_in_operational_only_and_a_stopped_drive_answers_nothing(
    master: Master,
) -> None:
    remap(master, 1, [0x60640020], 1)
    master.network.nmt.send_command(0x80)
    master.received.clear()
    master.sync(3)
    assert master.received == []
    master.network.nmt.send_command(0x02)
    master.nodes[INSERTION].sdo.RESPONSE_TIMEOUT = 0.001
    with pytest.raises(canopen.SdoCommunicationError):
        master.read(0x1000)


def test_a_lost_heartbeat_of_the_master_is_an_emergency_and_a_fault(master: Master) -> None:
    master.enable(8)
    master.write(0x1016, 1, MASTER << 16 | 100, 4)
    # Monitoring begins with the first heartbeat.
    master.wait(0.5)
    assert master.state() == 0x27
    for _ in range(10):
        master.network.send_message(0x700 + MASTER, b"\5")
        master.wait(0.09)
    assert master.state() == 0x27
    master.received.clear()
    master.wait(0.02)
    assert master.frames(0x81) == [bytes([0x30, 0x81, 0x11, 0, 0, 0, 0, 0])]
    assert master.read(0x603F) == 0x8130
    master.sync()
    assert master.state() == 0x08
    # 0x1029 is 0: it leaves OPERATIONAL. The other drive monitors no heartbeat.
    assert master.bus.drives["insertion"].network_state == 0x7F
    assert master.bus.drives["rotation"].network_state == 0x05
