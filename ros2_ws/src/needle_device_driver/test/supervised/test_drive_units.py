"""Units in which drives take speeds and ramps: told, converted, assumed or refused."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from needle_device_driver.supervisor.states import State

from .checks import in_state, steps
from .drive_bench import DriveBench
from .scripted_drives import ScriptedDrive

COUNTS, COUNTS_2 = 0x00B5_0300, 0x00B5_5700
RPM, RPM_S = 0x00B4_4700, 0x00C0_0300
RANGE, OTHER_ABORT = 0x0609_0030, 0x0800_0000


Values = dict[tuple[int, int], int]


def tells(drive: ScriptedDrive, codes: dict[int, int | None], values: Values | None = None) -> None:
    """Let a drive have unit codes, None for one that it lacks, and other values."""
    drive.missing_objects |= {index for index, code in codes.items() if code is None}
    values = (values or {}) | {
        (index, 0): code for index, code in codes.items() if code is not None
    }
    drive.objects |= {at: value.to_bytes(4, "little") for at, value in values.items()}


def holds(drive: ScriptedDrive, index: int, sub: int = 0) -> int:
    return int.from_bytes(drive.objects[index, sub], "little")


def refusal(bench: DriveBench) -> str:
    reply = bench.run(bench.supervisor.configure(bench.clock()))
    assert not reply.success
    assert not any(data[:1] == b"\x0f" for cob, data in bench.bus.sent if cob in (0x201, 0x202))
    return str(reply.message)


TURN = {(0x608F, 1): 20_000, (0x608F, 2): 1}


@pytest.mark.parametrize(
    ("speed", "ramp", "turn", "per_speed", "per_ramp"),
    [
        (COUNTS, COUNTS_2, {}, 1.0, 1.0),
        # Per second without dimension; bits that mean nothing.
        (0x0000_0300, 0x0000_5700, {}, 1.0, 1.0),
        (COUNTS | 0x5A, COUNTS_2, {}, 1.0, 1.0),
        # 0.1 counts/s and 10 counts/s^2 (Copley); thousands.
        (0xFFB5_0300, 0x01B5_5700, {}, 0.1, 10.0),
        (0x03B5_0300, 0xFEB5_5700, {}, 1000.0, 0.01),
        (RPM, RPM_S, TURN, 20_000 / 60, 20_000 / 60),
        # mrpm and mrpm/s; 0.1 rpm with ramps in rpm/s.
        (0xFDB4_4700, 0xFDC0_0300, TURN, 1 / 3, 1 / 3),
        (0xFFB4_4700, RPM_S, TURN, 2000 / 60, 20_000 / 60),
        # Seven turns of the encoder in two of the motor; a gear; no gear after all.
        (RPM, RPM_S, {(0x608F, 1): 40_000, (0x608F, 2): 2}, 20_000 / 60, 20_000 / 60),
        (RPM, RPM_S, {**TURN, (0x6091, 1): 5, (0x6091, 2): 2}, 50_000 / 60, 50_000 / 60),
        (RPM, RPM_S, {**TURN, (0x6091, 1): 0, (0x6091, 2): 0}, 20_000 / 60, 20_000 / 60),
        # What is in rpm may have ramps in counts, and the other way round.
        (RPM, COUNTS_2, TURN, 20_000 / 60, 1.0),
        (COUNTS, RPM_S, TURN, 1.0, 20_000 / 60),
    ],
)
def test_every_speed_and_ramp_is_written_in_the_unit_that_the_drive_tells(
    drive_bench: DriveBench,
    speed: int,
    ramp: int,
    turn: Values,
    per_speed: float,
    per_ramp: float,
) -> None:
    bench, drive = drive_bench, drive_bench.insertion
    tells(drive, {0x60A9: speed, 0x60AA: ramp}, turn)
    steps(bench)
    assert bench.drives.missing_optional_objects == ()
    # 5 mm/s, 2 mm/s to the switch, a quarter off it; 50 mm/s^2, stops at 500 mm/s^2.
    for index, sub, counts in (
        (0x607F, 0, 100_000),
        (0x6081, 0, 100_000),
        (0x6099, 1, 40_000),
        (0x6099, 2, 10_000),
    ):
        assert holds(drive, index, sub) == max(1, round(counts / per_speed)), hex(index)
    for index, counts in (
        (0x6083, 1_000_000),
        (0x6084, 1_000_000),
        (0x609A, 1_000_000),
        (0x6085, 10_000_000),
    ):
        assert holds(drive, index) == round(counts / per_ramp), hex(index)


def test_distances_stay_in_counts_whatever_speeds_are_in(drive_bench: DriveBench) -> None:
    drive = drive_bench.insertion
    tells(drive, {0x60A9: RPM, 0x60AA: RPM_S}, TURN)
    steps(drive_bench)
    assert holds(drive, 0x6065) == 10_000
    assert holds(drive, 0x607D, 2) == 4_020_000


def test_counts_per_turn_of_the_configuration_go_before_those_of_the_drive(
    make_drive_bench: Callable[..., DriveBench],
) -> None:
    bench = make_drive_bench(insertion_counts_per_turn=5000.0, rotation_counts_per_turn=65536.0)
    tells(bench.insertion, {0x60A9: RPM, 0x60AA: RPM_S}, TURN)
    tells(bench.rotation, {0x60A9: RPM, 0x60AA: RPM_S})
    bench.configured()
    assert holds(bench.insertion, 0x6085) == 120_000
    # 100 rad/s^2 are 955 rpm/s.
    assert holds(bench.rotation, 0x6085) == 955


@pytest.mark.parametrize(("has", "taken"), [(29_990, True), (60_001, False)])
def test_a_ramp_that_is_read_back_is_compared_in_the_unit_of_the_drive(
    drive_bench: DriveBench, has: int, taken: bool
) -> None:
    drive = drive_bench.insertion
    tells(drive, {0x60A9: RPM, 0x60AA: RPM_S}, TURN)
    drive.stores = lambda index, value: has.to_bytes(4, "little") if index == 0x6085 else value
    reply = drive_bench.run(drive_bench.supervisor.configure(drive_bench.clock()))
    assert reply.success is taken
    assert taken or "took 30000 for 0x6085:0 quick stop deceleration" in reply.message


@pytest.mark.parametrize(
    ("codes", "text"),
    [
        ({0x60A9: 0x0001_0300}, "speeds in m/s (0x60A9 = 0x00010300), wanted counts/s or rpm"),
        ({0x60A9: 0xFD01_0300}, "speeds in 10^-3 m/s (0x60A9 = 0xFD010300)"),
        ({0x60A9: 0x0010_0300}, "speeds in rad/s (0x60A9 = 0x00100300)"),
        ({0x60A9: 0x00B4_0300}, "speeds in turns/s (0x60A9 = 0x00B40300)"),
        ({0x60A9: 0xFAB4_0300}, "speeds in 10^-6 turns/s (0x60A9 = 0xFAB40300)"),
        ({0x60A9: 0x00B5_4700}, "speeds in counts/min (0x60A9 = 0x00B54700)"),
        ({0x60A9: 0x0041_4700}, "speeds in deg/min (0x60A9 = 0x00414700)"),
        ({0x60A9: 0x00B5_0000}, "speeds in counts (0x60A9 = 0x00B50000)"),
        ({0x60A9: 0xFF00_0000}, "speeds in 10^-1 counts (0x60A9 = 0xFF000000)"),
        ({0x60A9: 0x7F77_9900}, "speeds in 10^127 unit 0x77 per unit 0x99 (0x60A9 = 0x7F779900)"),
        ({0x60AA: 0x0001_5700}, "ramps in m/s^2 (0x60AA = 0x00015700), wanted counts/s^2 or rpm/s"),
        ({0x60AA: 0x00B5_0300}, "ramps in counts/s (0x60AA = 0x00B50300)"),
        ({0x60AA: RPM}, "ramps in rpm (0x60AA = 0x00B44700)"),
        ({0x60A9: RPM_S}, "speeds in rpm/s (0x60A9 = 0x00C00300)"),
        ({0x60A8: 0xFD01_0000}, "positions in 10^-3 m (0x60A8 = 0xFD010000), wanted counts"),
        ({0x60A8: 0x0041_0000}, "positions in deg (0x60A8 = 0x00410000)"),
        ({0x60A8: 0x00B4_0000}, "positions in turns (0x60A8 = 0x00B40000)"),
        ({0x60A8: 0xFFB5_0000}, "positions in 10^-1 counts (0x60A8 = 0xFFB50000)"),
    ],
)
@pytest.mark.parametrize("axis", ["insertion", "rotation"])
def test_a_unit_that_is_neither_counts_nor_rpm_is_refused_by_name_value_and_what_is_wanted(
    drive_bench: DriveBench, axis: str, codes: dict[int, int | None], text: str
) -> None:
    tells(getattr(drive_bench, axis), codes, TURN)
    assert f"{axis} axis: the drive counts {text}" in refusal(drive_bench)


@pytest.mark.parametrize("turn", [{}, {(0x608F, 1): 0, (0x608F, 2): 1}, {(0x608F, 1): 20_000}])
def test_rpm_that_cannot_be_counted_are_refused_with_the_way_out(
    drive_bench: DriveBench, turn: Values
) -> None:
    tells(drive_bench.insertion, {0x60A9: RPM, 0x60AA: RPM_S}, turn)
    assert refusal(drive_bench) == (
        "insertion axis: the drive counts speeds in rpm (0x60A9 = 0x00B44700), wanted counts/s; "
        "*_counts_per_turn converts rpm without 0x608F"
    )


@pytest.mark.parametrize(
    ("feed", "per_turn", "taken"),
    [
        ((50_000, 1), 0.0, True),
        ((100_000, 2), 0.0, True),
        ((50_000, 0), 0.0, True),
        ((360, 1), 0.0, False),
        ((1_000_000, 1), 0.0, False),
        ((360, 1), 50_000.0, True),
    ],
)
def test_a_feed_that_contradicts_the_encoder_and_the_gear_is_refused_with_the_way_out(
    make_drive_bench: Callable[..., DriveBench],
    feed: tuple[int, int],
    per_turn: float,
    taken: bool,
) -> None:
    # A drive scales its positions by 0x6092: its counts may be others than the encoder's.
    bench = make_drive_bench(insertion_counts_per_turn=per_turn)
    ratios = {(0x6091, 1): 5, (0x6091, 2): 2, (0x6092, 1): feed[0], (0x6092, 2): feed[1]}
    tells(bench.insertion, {0x60A9: RPM, 0x60AA: RPM_S}, TURN | ratios)
    if taken:
        bench.configured()
        assert holds(bench.insertion, 0x6085) == 12_000
        return
    assert refusal(bench) == (
        f"insertion axis: the drive tells 50000 (0x608F, 0x6091) and {feed[0]:g} (0x6092) counts "
        "in a turn: *_counts_per_turn says which"
    )


@pytest.mark.parametrize(
    ("codes", "told"),
    [
        ({0x60A9: None, 0x60AA: None}, "counts/s (0x60A9), counts/s^2 (0x60AA);"),
        ({0x60A8: None, 0x60A9: None, 0x60AA: None}, "counts/s (0x60A9), counts/s^2 (0x60AA);"),
        ({0x60A9: 0, 0x60AA: 0}, "counts/s (0x60A9), counts/s^2 (0x60AA);"),
        ({0x60A9: None}, "counts/s (0x60A9);"),
        ({0x60AA: None}, "the unit of its speeds per second (0x60AA);"),
    ],
)
def test_units_that_a_drive_does_not_tell_are_counts_and_said_once(
    drive_bench: DriveBench, codes: dict[int, int | None], told: str
) -> None:
    bench = drive_bench
    tells(bench.insertion, codes)
    steps(bench)
    (text,) = bench.drives.missing_optional_objects
    assert text.startswith(f"insertion drive does not tell its units; assumed: {told}")
    assert holds(bench.insertion, 0x6085) == 10_000_000
    assert holds(bench.insertion, 0x6099, 1) == 40_000


def test_ramps_that_a_drive_in_rpm_does_not_tell_are_in_rpm_per_second(
    drive_bench: DriveBench,
) -> None:
    tells(drive_bench.insertion, {0x60A9: RPM, 0x60AA: None}, TURN)
    drive_bench.configured()
    assert holds(drive_bench.insertion, 0x6085) == 30_000


def test_a_drive_that_refuses_to_tell_a_unit_does_not_tell_it(drive_bench: DriveBench) -> None:
    drive = drive_bench.insertion
    sdo = drive.sdo

    def refusing(data: bytes) -> None:
        if data[:1] == b"\x40" and data[1:3] in (b"\xa9\x60", b"\x8f\x60"):
            drive.say(0x580, b"\x80" + data[1:4] + OTHER_ABORT.to_bytes(4, "little"))
        else:
            sdo(data)

    drive.sdo = refusing  # type: ignore[method-assign]
    steps(drive_bench)
    assert "assumed: counts/s (0x60A9);" in drive_bench.drives.missing_optional_objects[0]


@pytest.mark.parametrize(
    ("above", "below", "taken"), [(1, 1, True), (7, 7, True), (60, 20_000, False), (0, 1, True)]
)
def test_a_velocity_factor_stands_for_a_unit_that_is_not_told(
    drive_bench: DriveBench, above: int, below: int, taken: bool
) -> None:
    factor = {(0x6096, 1): above, (0x6096, 2): below, (0x6091, 1): 1, (0x6091, 2): 1}
    tells(drive_bench.insertion, {0x60A9: None, 0x60AA: None}, TURN | factor)
    if taken:
        steps(drive_bench)
        return
    text = refusal(drive_bench)
    assert text == ("insertion axis: the drive scales speeds by 0.003 (0x6096), wanted counts/s")


def test_a_velocity_factor_beside_a_unit_that_is_told_counts_for_nothing(
    drive_bench: DriveBench,
) -> None:
    tells(drive_bench.insertion, {}, {(0x6096, 1): 60, (0x6096, 2): 20_000})
    steps(drive_bench)


def test_a_homing_that_is_slower_than_the_unit_of_the_drive_is_refused(
    make_drive_bench: Callable[..., DriveBench],
) -> None:
    bench = make_drive_bench(homing_speed=1e-5)
    tells(bench.insertion, {0x60A9: RPM, 0x60AA: RPM_S}, TURN)
    bench.configured()
    bench.supervisor.confirm_needle_out(True)
    reply = bench.run(bench.supervisor.home(bench.clock()))
    assert not reply.success
    assert "homing at 1e-05/s is less than one of the drive's units of speed" in reply.message
    assert in_state(bench, State.FAULT)
    bench.cycle(20)
    assert bench.positions == (0, 0)


def test_an_encoder_of_a_hand_moved_axis_needs_positions_in_counts_alone(
    make_drive_bench: Callable[..., DriveBench],
) -> None:
    bench = make_drive_bench(insertion_drive="hand")
    tells(bench.insertion, {0x60A9: 0x0001_0300, 0x60AA: None})
    bench.configured()
    assert bench.drives.missing_optional_objects == ()
    other = make_drive_bench(insertion_drive="hand")
    tells(other.insertion, {0x60A8: 0x0001_0000})
    assert "insertion axis: the drive counts positions in m (0x60A8" in refusal(other)


def test_a_drive_that_started_anew_is_asked_anew(drive_bench: DriveBench) -> None:
    bench, drive = drive_bench, drive_bench.insertion
    tells(drive, {0x60A9: RPM, 0x60AA: RPM_S}, TURN)
    bench.configured()
    assert holds(drive, 0x6085) == 30_000
    tells(drive, {}, {(0x608F, 1): 10_000})
    drive.reboot()
    bench.bus.flush()
    bench.cycle(2)
    assert in_state(bench, State.FAULT)
    assert bench.run(bench.supervisor.reset(bench.clock())).success
    assert holds(drive, 0x6085) == 60_000


@pytest.mark.parametrize(("modes", "taken"), [({6, 8}, True), ({6}, False)])
def test_a_drive_that_does_not_list_cyclic_position_mode_is_tried(
    drive_bench: DriveBench, modes: set[int], taken: bool
) -> None:
    # An EPOS4 lists 0x225, and has it.
    drive = drive_bench.insertion
    drive.objects[0x6502, 0] = (0x225).to_bytes(4, "little")
    drive.modes = modes
    if taken:
        steps(drive_bench)
        return
    assert refusal(drive_bench) == (
        "insertion axis: node 1 has no cyclic synchronous position mode (0x6060 = 8, 0x6061 = 0)"
    )


def test_a_drive_that_refuses_the_mode_that_it_does_not_list_is_refused(
    drive_bench: DriveBench,
) -> None:
    drive = drive_bench.insertion
    drive.objects[0x6502, 0] = (0x225).to_bytes(4, "little")
    drive.refuses = lambda index, sub, value: RANGE if (index, value) == (0x6060, b"\x08") else 0
    assert "node 1 refuses to write 8 to 0x6060:0 mode of operation" in refusal(drive_bench)


def test_a_mode_display_may_take_its_time(drive_bench: DriveBench) -> None:
    drive = drive_bench.insertion
    drive.objects[0x6502, 0] = (0x225).to_bytes(4, "little")
    drive.modes = set()
    sdo, asked = drive.sdo, []

    def slowly(data: bytes) -> None:
        if data[:3] == b"\x40\x61\x60":
            asked.append(data)
            drive.mode = 8 if len(asked) > 40 else drive.mode
        sdo(data)

    drive.sdo = slowly  # type: ignore[method-assign]
    assert drive_bench.run(drive_bench.supervisor.configure(drive_bench.clock())).success
    assert len(asked) >= 41


def test_a_drive_without_homing_mode_is_refused_whatever_else_it_lists(
    drive_bench: DriveBench,
) -> None:
    drive_bench.insertion.objects[0x6502, 0] = (0x205).to_bytes(4, "little")
    assert "node 1 has no homing mode (0x6502 = 0x00000205)" in refusal(drive_bench)
