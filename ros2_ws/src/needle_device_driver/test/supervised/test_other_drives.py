"""Drives of other makers: what CiA 301 and CiA 402 leave open, each way on its own."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from needle_device_driver.axes.axis import AxisError
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.states import State

from .checks import failed, in_state, recovers, steps
from .drive_bench import DriveBench

READ_ONLY, RANGE, OTHER_STATE = 0x0601_0002, 0x0609_0030, 0x0800_0022
TOO_LONG = 0x0607_0012


def refuse(code: int, *indices: int) -> Callable[[int, int, bytes], int]:
    """Return a drive's refusal to have these objects written."""
    return lambda index, sub, value: code if index in indices else 0


# ---- objects ---------------------------------------------------------------------------------


def test_a_setting_that_a_drive_keeps_for_itself_is_told(drive_bench: DriveBench) -> None:
    drive_bench.insertion.refuses = refuse(RANGE, 0x605B, 0x607F, 0x609A, 0x1029, 0x1006)
    steps(drive_bench)
    assert [text.partition(":")[0] for text in drive_bench.drives.missing_optional_objects] == [
        "insertion drive keeps its own 0x605B",
        "insertion drive keeps its own 0x607F",
        "insertion drive keeps its own 0x609A",
    ]


@pytest.mark.parametrize("index", [0x605A, 0x605E, 0x6007, 0x6065, 0x6085, 0x60C2, 0x607D])
def test_a_setting_that_a_rule_needs_is_not_left_to_a_drive(
    drive_bench: DriveBench, index: int
) -> None:
    drive_bench.insertion.refuses = refuse(RANGE, index)
    reply = drive_bench.run(drive_bench.supervisor.configure(drive_bench.clock()))
    assert not reply.success
    assert f"0x{index:04X}" in reply.message
    assert "insertion axis: node 1 refuses to write" in reply.message


@pytest.mark.parametrize(("fixed", "taken"), [(50, True), (200, True), (0, False), (201, False)])
def test_a_heartbeat_that_is_fixed_may_be_slower(
    drive_bench: DriveBench, fixed: int, taken: bool
) -> None:
    drive_bench.insertion.objects[0x1017, 0] = fixed.to_bytes(2, "little")
    drive_bench.insertion.refuses = refuse(READ_ONLY, 0x1017)
    reply = drive_bench.run(drive_bench.supervisor.configure(drive_bench.clock()))
    assert reply.success is taken
    assert taken or "node 1 refuses to write 30 to 0x1017:0" in reply.message


@pytest.mark.parametrize("lacks", [None, 6, 8])
def test_a_drive_that_lists_no_modes_is_told_each(
    drive_bench: DriveBench, lacks: int | None
) -> None:
    drive = drive_bench.insertion
    del drive.objects[0x6502, 0]
    drive.state = "enabled"
    drive.refuses = lambda index, sub, value: (
        (OTHER_STATE if drive.state == "enabled" else RANGE if value[0] == lacks else 0)
        if index == 0x6060
        else 0
    )
    if lacks is None:
        steps(drive_bench)
        return
    reply = drive_bench.run(drive_bench.supervisor.configure(drive_bench.clock()))
    assert f"node 1 refuses to write {lacks} to 0x6060:0 mode of operation" in reply.message
    assert "(docs/hardware.md says what for)" in reply.message


def test_what_a_drive_has_already_it_need_not_take(drive_bench: DriveBench) -> None:
    drive_bench.insertion.objects[0x605A, 0] = b"\x06\x00"
    drive_bench.insertion.refuses = refuse(READ_ONLY, 0x605A)
    steps(drive_bench)


def test_software_limits_that_cannot_be_written_refuse_the_drive_before_it_moves(
    drive_bench: DriveBench,
) -> None:
    drive = drive_bench.insertion
    # What an un-homed drive shall have, by chance.
    drive.objects |= {(0x607D, 1): b"\0\0\0\x80", (0x607D, 2): b"\xff\xff\xff\x7f"}
    drive.refuses = refuse(READ_ONLY, 0x607D)
    reply = drive_bench.run(drive_bench.supervisor.configure(drive_bench.clock()))
    assert "refuses to write -2147483648 to 0x607D:1" in reply.message


def test_an_object_of_another_width_is_written_as_wide_as_it_is(drive_bench: DriveBench) -> None:
    widths = {(0x605A, 0): 1, (0x6066, 0): 4, (0x60C2, 1): 2}
    drive = drive_bench.insertion
    drive.objects |= {where: bytes(width) for where, width in widths.items()}

    def refuses(index: int, sub: int, value: bytes) -> int:
        return TOO_LONG if len(value) != widths.get((index, sub), len(value)) else 0

    drive.refuses = refuses
    steps(drive_bench)
    assert drive.objects[0x605A, 0] == b"\x06"
    assert drive.objects[0x6066, 0] == (50).to_bytes(4, "little")
    assert drive.objects[0x60C2, 1] == b"\x14\x00"


@pytest.mark.parametrize(
    ("index", "wanted", "has", "taken"),
    [
        # Following error: rounded down, never up.
        (0x6065, 10_000, 9984, True),
        (0x6065, 10_000, 10_001, False),
        (0x6065, 10_000, 4000, False),
        # Quick stop ramp: rounded, but not clipped.
        (0x6085, 10_000_000, 9_999_488, True),
        (0x6085, 10_000_000, 10_000_384, True),
        (0x6085, 10_000_000, 65_535, False),
        # A home that is elsewhere; set-points that are run through faster than they come.
        (0x607C, 0, 5, False),
        (0x60C2, 20, 10, False),
        # No rule hangs on these.
        (0x6083, 1_000_000, 65_535, True),
        (0x609A, 1_000_000, 65_535, True),
    ],
)
def test_what_a_drive_makes_of_a_setting_is_read_back_where_a_rule_needs_it(
    drive_bench: DriveBench, index: int, wanted: int, has: int, taken: bool
) -> None:
    drive_bench.insertion.stores = lambda at, value: (
        has.to_bytes(len(value), "little")
        if at == index and value == wanted.to_bytes(len(value), "little")
        else value
    )
    reply = drive_bench.run(drive_bench.supervisor.configure(drive_bench.clock()))
    assert reply.success is taken
    assert taken or f"took {wanted} for 0x{index:04X}" in reply.message
    assert taken or reply.message.endswith(f"and has {has}")


def test_no_limits_are_as_wide_as_the_drive_counts(drive_bench: DriveBench) -> None:
    drive = drive_bench.insertion

    def refuses(index: int, sub: int, value: bytes) -> int:
        counts = int.from_bytes(value, "little", signed=True)
        return RANGE if index == 0x607D and abs(counts) > 2**30 else 0

    drive.refuses = refuses
    drive_bench.configured()
    assert drive.objects[0x607D, 1] == (-(2**30)).to_bytes(4, "little", signed=True)
    assert drive.objects[0x607D, 2] == (2**30 - 1).to_bytes(4, "little")


def test_software_limits_are_written_once_the_homed_drive_is_off(drive_bench: DriveBench) -> None:
    bench = drive_bench
    drive = bench.insertion
    drive.refuses = lambda index, sub, value: (
        OTHER_STATE if index == 0x607D and drive.state in ("enabled", "quick stop") else 0
    )
    steps(bench)
    assert bench.written(1, 0x607D, 1) == (-20_000).to_bytes(4, "little", signed=True)
    assert bench.written(2, 0x607D, 2) == (657_446).to_bytes(4, "little")


def test_software_limits_that_a_homed_drive_does_not_take_keep_it_from_being_switched_on(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.configured()
    bench.supervisor.confirm_needle_out(True)
    assert bench.run(bench.supervisor.home(bench.clock())).success
    bench.insertion.refuses = refuse(RANGE, 0x607D)
    bench.cycle(30)
    assert in_state(bench, State.FAULT)
    assert "refuses to write -20000 to 0x607D:1" in bench.status.fault
    bench.run(bench.supervisor.reset(bench.clock()))
    assert not bench.supervisor.enable(True, bench.clock()).success
    with pytest.raises(AxisError, match="insertion axis has no software limits yet"):
        bench.axes[0].power(True)
    bench.cycle(1)
    assert in_state(bench, State.FAULT)
    assert "refuses to write -20000 to 0x607D:1" in bench.status.fault


def test_between_homing_and_its_software_limits_nothing_is_switched_on(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.configured()
    bench.supervisor.confirm_needle_out(True)
    assert bench.run(bench.supervisor.home(bench.clock())).success
    for _ in range(30):
        bench.cycle(1)
        # Whoever is in a hurry is asked to call again, and breaks nothing.
        if bench.status.homed and bench.supervisor.enable(True, bench.clock()).success:
            break
        assert not in_state(bench, State.FAULT)
    assert in_state(bench, State.HOLDING)
    assert bench.written(1, 0x607D, 1) == (-20_000).to_bytes(4, "little", signed=True)


def test_software_limits_are_taken_from_slow_drives_with_few_heartbeats(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.configured()
    for drive in (bench.insertion, bench.rotation):

        def slowly(data: bytes, sdo: Callable[[bytes], None] = drive.sdo) -> None:
            bench.now += 0.09
            sdo(data)

        def say(function: int, data: bytes, said: Callable[..., None] = drive.say) -> None:
            if function != 0x700:
                said(function, data)

        drive.sdo, drive.say = slowly, say  # type: ignore[method-assign]
    bench.supervisor.confirm_needle_out(True)
    assert bench.run(bench.supervisor.home(bench.clock())).success
    bench.cycle(30)
    assert in_state(bench, State.DISABLED), bench.status.fault
    assert bench.status.homed
    assert bench.written(1, 0x607D, 1) == (-20_000).to_bytes(4, "little", signed=True)
    assert bench.supervisor.enable(True, bench.clock()).success


# ---- states ----------------------------------------------------------------------------------


def test_a_stopped_node_is_found(drive_bench: DriveBench) -> None:
    drive_bench.insertion.nmt = drive_bench.rotation.nmt = 0x04
    assert drive_bench.run(drive_bench.drives.probe()) == ""
    steps(drive_bench)


def test_a_node_without_heartbeat_is_told_from_one_that_does_not_start(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    said, take = bench.rotation.say, bench.rotation.take
    bench.rotation.say = lambda function, data: (  # type: ignore[method-assign]
        None if function == 0x700 else said(function, data)
    )

    def impatient(cob_id: int, data: bytes) -> None:
        # Nobody waits a second for what does not come.
        bench.now += 0.1 * (cob_id == 0x77F)
        take(cob_id, data)

    bench.rotation.take = impatient  # type: ignore[method-assign]
    reply = bench.run(bench.supervisor.configure(bench.clock()))
    assert "rotation axis: node 2 sends no heartbeat (0x1017)" in reply.message
    assert "insertion axis" not in reply.message


def test_a_powered_drive_is_off_before_it_is_set_up(drive_bench: DriveBench) -> None:
    drive = drive_bench.insertion
    drive.state = "enabled"
    command, sdo, asked = drive.command, drive.sdo, []

    def slowly(data: bytes) -> None:
        sdo(data)
        if data[1:3] == b"\x41\x60":
            asked.append(drive.state)
            if len(asked) == 5:
                command(0)

    drive.sdo = slowly  # type: ignore[method-assign]
    drive.command = lambda word: None  # type: ignore[method-assign]
    drive.refuses = lambda index, sub, value: (
        OTHER_STATE if index != 0x6040 and index >= 0x6000 and drive.state == "enabled" else 0
    )
    assert drive_bench.run(drive_bench.supervisor.configure(drive_bench.clock())).success
    assert asked[:6] == ["enabled"] * 5 + ["disabled"]


def test_a_fault_is_acknowledged_in_the_process_data(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    for drive in (bench.insertion, bench.rotation):
        drive.ignores_sdo_orders = True
    bench.rotation.fail(0x7121)
    bench.bus.flush()
    bench.cycle(1, holding=True)
    failed(bench, Rule.DRIVE_EMERGENCY, "motor blocked")
    recovers(bench)


def test_a_fault_that_stays_in_a_drive_without_error_code_is_told_all_the_same(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.configured()
    drive = bench.insertion
    drive.state, drive.deaf_to_reset, drive.missing_objects = "fault", True, {0x603F}
    bench.cycle(1)
    sdo = drive.sdo

    def late(data: bytes) -> None:
        bench.now += 0.05
        sdo(data)

    drive.sdo = late  # type: ignore[method-assign]
    reply = bench.run(bench.supervisor.reset(bench.clock()))
    assert reply.message == "insertion axis: the drive does not leave its fault"


def test_a_drive_that_does_not_say_that_it_is_off_keeps_its_watchdog(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.moving()
    sync = bench.insertion.sync
    bench.insertion.sync = lambda: None  # type: ignore[method-assign]
    reply = bench.run(bench.supervisor.deconfigure())
    bench.insertion.sync = sync  # type: ignore[method-assign]
    assert not reply.success
    assert "insertion axis: does not say that it is off" in bench.notices[-1].text
    assert bench.written(1, 0x1016, 1) != bytes(4)
    assert bench.written(2, 0x1016, 1) == bytes(4)


# ---- homing ----------------------------------------------------------------------------------


def test_a_homing_method_that_a_drive_lacks_is_known_before_anything_moves(
    drive_bench: DriveBench,
) -> None:
    drive_bench.insertion.refuses = refuse(RANGE, 0x6098)
    reply = drive_bench.run(drive_bench.supervisor.configure(drive_bench.clock()))
    assert "refuses to write 17 to 0x6098:0 homing method" in reply.message


def test_a_drive_that_is_refused_leaves_the_other_one_without_watchdog(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.insertion.refuses = refuse(RANGE, 0x6098)
    assert not bench.run(bench.supervisor.configure(bench.clock())).success
    assert bench.rotation.nmt == 0x05
    assert bench.written(2, 0x1016, 1) == bytes(4)
    # And may be configured once the first is mended.
    bench.insertion.refuses = refuse(RANGE)
    assert bench.run(bench.supervisor.reset(bench.clock())).success
    steps(bench)


def test_where_it_stands_has_two_numbers(drive_bench: DriveBench) -> None:
    drive_bench.rotation.refuses = lambda index, sub, value: (
        RANGE if index == 0x6098 and value != b"\x23" else 0
    )
    steps(drive_bench)
    assert drive_bench.rotation.objects[0x6098, 0] == b"\x23"


def test_a_homing_ends_by_its_second_bit_where_the_first_stays_for_good(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.homed()
    drive = bench.insertion
    drive.position, drive.home_after, drive.stale_homing = 3000, 20, True
    drive.more_status = 0x1400
    bench.supervisor.confirm_needle_out(True)
    assert bench.run(bench.supervisor.home(bench.clock())).success
    bench.cycle(4)
    for _ in range(15):
        # Under way: attained once, not at the target.
        drive.more_status = 0x1000
        bench.cycle(1)
        assert not bench.status.homed
    bench.cycle(20)
    assert bench.status.homed
    assert drive.position == 0
