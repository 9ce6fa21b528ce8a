"""Process data of other makers' drives: what CiA 301 leaves open, each way on its own."""

from __future__ import annotations

import pytest

from needle_device_driver.rules import Rule

from .checks import failed, recovers, steps
from .drive_bench import DriveBench

NOT_MAPPABLE, RANGE, OTHER_STATE = 0x0604_0041, 0x0609_0030, 0x0800_0022


def test_process_data_is_off_while_its_address_or_mapping_changes(drive_bench: DriveBench) -> None:
    drive = drive_bench.insertion
    drive.objects[0x1801, 1] = (0x4000_0291).to_bytes(4, "little")

    def refuses(index: int, sub: int, value: bytes) -> int:
        if not 0x1400 <= index <= 0x1BFF:
            return 0
        cob_id = int.from_bytes(drive.objects[index & ~0x200, 1], "little")
        on = not cob_id >> 31
        if sub != 1 or index & 0x200:
            return OTHER_STATE if on else 0
        new = int.from_bytes(value, "little")
        if index >= 0x1800 and not new & 1 << 30:
            return RANGE
        return OTHER_STATE if on and (new ^ cob_id) & 0x7FF else 0

    drive.refuses = refuses
    steps(drive_bench)
    assert drive.objects[0x1801, 1] == (0x4000_0281).to_bytes(4, "little")


def test_process_data_that_nobody_asked_for_is_switched_off(drive_bench: DriveBench) -> None:
    drive = drive_bench.insertion
    drive.objects[0x1802, 1] = (0x4000_0381).to_bytes(4, "little")
    drive_bench.configured()
    assert drive.objects[0x1802, 1] == (0xC000_0381).to_bytes(4, "little")
    for index in (0x1800, 0x1801):
        # An answer is neither held back after a SYNC nor sent without one.
        assert drive.objects[index, 3] == drive.objects[index, 5] == bytes(2)


@pytest.mark.parametrize(
    ("lacks", "order", "set_point"),
    [(b"\xff", 0xFE, 1), (b"\x01", 0xFF, 0xFF), (b"\x01\xff", 0xFE, 0xFE)],
    ids=["type 255", "type 1", "both"],
)
def test_what_a_drive_receives_acts_at_once_where_it_has_no_other_type(
    drive_bench: DriveBench, lacks: bytes, order: int, set_point: int
) -> None:
    drive = drive_bench.insertion
    drive.refuses = lambda index, sub, value: (
        RANGE if 0x1400 <= index < 0x1500 and sub == 2 and value in (lacks[:1], lacks[1:]) else 0
    )
    steps(drive_bench)
    assert (drive.objects[0x1400, 2], drive.objects[0x1401, 2]) == (
        bytes([order]),
        bytes([set_point]),
    )


def test_a_drive_that_answers_no_sync_is_refused(drive_bench: DriveBench) -> None:
    drive_bench.insertion.refuses = lambda index, sub, value: (
        RANGE if 0x1800 <= index < 0x1900 and sub == 2 and value == b"\x01" else 0
    )
    reply = drive_bench.run(drive_bench.supervisor.configure(drive_bench.clock()))
    assert "node 1 refuses to write 1 to 0x1800:2 transmission type" in reply.message


def test_digital_inputs_that_cannot_be_mapped_are_done_without(drive_bench: DriveBench) -> None:
    drive = drive_bench.insertion
    drive.refuses = lambda index, sub, value: (
        NOT_MAPPABLE if index == 0x1A00 and value == b"\x20\x00\xfd\x60" else 0
    )
    drive.status_size = 3
    steps(drive_bench)
    assert drive.objects[0x1A00, 0] == b"\x02"
    assert "no digital inputs" in drive_bench.drives.missing_optional_objects[0]


def test_an_answer_that_is_one_sync_old_does_not_bring_a_fault_back(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.moving()
    bench.insertion.tells_late = bench.rotation.tells_late = True
    bench.rotation.fail(0x7121)
    bench.bus.flush()
    bench.cycle(1, holding=True)
    failed(bench, Rule.DRIVE_EMERGENCY, "motor blocked")
    recovers(bench)
