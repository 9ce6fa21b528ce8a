"""Set-up of drives of many makers: written objects, missing objects, refusals."""

from __future__ import annotations

from typing import Any

import pytest

from needle_device_driver.axes.axis import AxisError

from .drive_bench import DriveBench
from .scripted_drives import ScriptedDrive

Change = dict[str, Any]
Values = dict[tuple[int, int], int]

READ_ONLY, TOO_LONG, NOT_MAPPABLE = 0x0601_0002, 0x0607_0012, 0x0604_0041
RANGE = 0x0609_0030
COUNTS, COUNTS_2, RPM, RPM_S = 0x00B5_0300, 0x00B5_5700, 0x00B4_4700, 0x00C0_0300
TURN = {(0x608F, 1): 20_000, (0x608F, 2): 1}
IN_RPM = {(0x60A9, 0): RPM, (0x60AA, 0): RPM_S, **TURN}
# 5 mm/s, 2 mm/s to the switch, a quarter of that away from it; 50 mm/s^2, stops at 500 mm/s^2.
SPEEDS = {(0x607F, 0): 100_000, (0x6081, 0): 100_000, (0x6099, 1): 40_000, (0x6099, 2): 10_000}
REQUIRED = {0x605A: 6, 0x605E: 2, 0x6007: 1, 0x607C: 0, 0x607D: 2**31 - 1, 0x60C2: 20}
RAMPS = {(0x6083, 0): 10**6, (0x6084, 0): 10**6, (0x609A, 0): 10**6, (0x6085, 0): 10**7}


def has(**attributes: object) -> Change:
    """Change attributes of a drive."""
    return attributes


def reports(values: Values) -> Change:
    """Set values of objects."""
    return has(objects={at: value.to_bytes(4, "little") for at, value in values.items()})


def change(drive: ScriptedDrive, attributes: Change) -> None:
    objects = drive.objects | attributes.get("objects", {})
    drive.__dict__.update(attributes, objects=objects)


def lacks(*indices: int) -> Change:
    return has(missing_objects=set(indices))


def refuses(code: int, *indices: int, but: bytes = b"none") -> Change:
    """Refuse writes to objects, except one value."""
    return has(refuses=lambda i, sub, value: code if i in indices and value != but else 0)


def makes(index: int, wanted: int, made: int) -> Change:
    """Store another value than the written one."""

    def stores(at: int, value: bytes) -> bytes:
        size = len(value)
        is_it = at == index and value == wanted.to_bytes(size, "little", signed=wanted < 0)
        return made.to_bytes(size, "little") if is_it else value

    return has(stores=stores)


def in_unit(index: int, code: int, unit: str) -> tuple[Change, str]:
    what = {0x60A8: "positions", 0x60A9: "speeds", 0x60AA: "ramps"}[index]
    text = f"the drive measures {what} in {unit} (0x{index:04X} = 0x{code:08X}), expected counts"
    return reports({**TURN, (index, 0): code}), text


def fed(*ratio: int) -> Change:
    """Give a drive in rpm a gear of 5 : 2 and a feed in counts."""
    gear = {(0x6091, 1): 5, (0x6091, 2): 2, (0x6092, 1): ratio[0], (0x6092, 2): ratio[1]}
    return reports(IN_RPM | gear)


REFUSED: list[tuple[Change, str]] = [
    (reports({(0x1000, 0): 401}), "node 1 has device profile 401, expected 402"),
    (reports({(0x1000, 0): 408}), "node 1 has device profile 408, expected 402"),
    (reports({(0x6502, 0): 0x205}), "node 1 has no homing mode (0x6502 = 0x00000205)"),
    (
        reports({(0x6502, 0): 0x225}) | has(modes={6}),
        "node 1 has no cyclic synchronous position mode (0x6060 = 8, 0x6061 = 0)",
    ),
    (lacks(0x6502) | has(modes={8}), "no homing mode (0x6060 = 6, 0x6061 = 0)"),
    (has(state="enabled", ignored_orders={"off"}), "node 1 does not switch off"),
    (makes(0x1016, 127 << 16 | 100, 0), "0x1016:1 consumer heartbeat time but reads back 0"),
    (reports({(0x1017, 0): 0}) | refuses(READ_ONLY, 0x1017), "30 to 0x1017:0"),
    (reports({(0x1017, 0): 201}) | refuses(READ_ONLY, 0x1017), "30 to 0x1017:0"),
    (refuses(RANGE, 0x605A), "node 1 refuses to write 6 to 0x605A:0"),
    (refuses(RANGE, 0x605E), "node 1 refuses to write 2 to 0x605E:0"),
    # Homing to a switch is never replaced by homing at the present position.
    (refuses(RANGE, 0x6098, but=b"\x25"), "refuses to write 17 to 0x6098:0"),
    *(
        (makes(index, value, 5), f"was set to {value} at 0x{index:04X}")
        for index, value in REQUIRED.items()
    ),
    # Units other than counts and rpm.
    in_unit(0x60A9, 0xFD01_0300, "10^-3 m/s"),
    in_unit(0x60A9, 0x0010_4700, "rad/min"),
    in_unit(0x60A9, 0x00B4_0300, "turns/s"),
    in_unit(0x60AA, 0x0041_5700, "deg/s^2"),
    in_unit(0x60A9, 0x7F77_9900, "10^127 unit 0x77 per unit 0x99"),
    in_unit(0x60AA, RPM, "rpm"),
    in_unit(0x60A8, 0xFFB5_0000, "10^-1 counts"),
    # Counts per turn unknown or ambiguous; an invalid factor.
    (
        reports({(0x60A9, 0): RPM, (0x608F, 1): 20_000}),
        "speeds in rpm (0x60A9 = 0x00B44700), expected counts/s; *_counts_per_turn converts",
    ),
    (fed(360, 1), "reports 50000 (0x608F, 0x6091) and 360 (0x6092) counts per turn"),
    (
        lacks(0x60A9, 0x60AA) | reports({(0x6096, 1): 60, (0x6096, 2): 20_000}),
        "the drive scales speeds by 0.003 (0x6096), expected counts/s",
    ),
    # It answers no SYNC.
    (
        has(refuses=lambda i, sub, v: RANGE * ((i, sub) == (0x1800, 2))),
        "node 1 refuses to write 1 to 0x1800:2 transmission type",
    ),
    (has(beats=False), "node 1 sends no heartbeat (0x1017)"),
]


@pytest.mark.parametrize(("drive", "text"), REFUSED)
def test_drive_without_a_required_object_or_value_is_refused(drive: Change, text: str) -> None:
    bench = DriveBench()
    change(bench.insertion, drive)
    bench.sdo_time = 0.02
    refusal = bench.refusal()
    assert refusal.startswith("insertion axis: ")
    assert text in refusal
    # The watchdog of the other axis is not armed.
    assert bench.rotation.value(0x1016, 1) == 0
    assert bench.state == "FAULT"


@pytest.mark.parametrize(
    ("drive", "seconds"),
    [
        (has(state="enabled", ignored_orders={"off"}), 1.0),
        (lacks(0x6502) | has(modes={8}), 0.5),
        (has(beats=False), 1.0),
    ],
)
def test_set_up_waits_a_limited_time(drive: Change, seconds: float) -> None:
    bench = DriveBench()
    change(bench.insertion, drive)
    bench.sdo_time = 0.001
    start = bench.now
    bench.refusal()
    assert seconds < bench.now - start < seconds + 0.3


def no_types(types: bytes) -> Change:
    """Refuse transmission types of received PDOs."""
    lacking = types[:1], types[1:]
    return has(
        refuses=lambda i, sub, v: RANGE * (i & 0xFF00 == 0x1400 and sub == 2 and v in lacking)
    )


Row = tuple[Change, Values, str]


def units(speed: int, ramp: int, more: Values, per_speed: float, per_ramp: float) -> Row:
    """Return a drive with units, and its expected speeds and ramps."""
    wanted = {at: max(1, round(counts / per_speed)) for at, counts in SPEEDS.items()}
    wanted |= {at: round(counts / per_ramp) for at, counts in RAMPS.items()}
    return reports({(0x60A9, 0): speed, (0x60AA, 0): ramp, **more}), wanted, ""


ASSUMED = "does not report its units; assumed: "
UNREPORTED_UNITS = f"{ASSUMED}counts/s (0x60A9), counts/s^2 (0x60AA);"
WIDTHS = {(0x605A, 0): 1, (0x6066, 0): 4, (0x60C2, 1): 2}
TAKEN: list[Row] = [
    (has(), {(0x6065, 0): 10_000, (0x607D, 1): -20_000, (0x607D, 2): 4_020_000}, ""),
    units(COUNTS, COUNTS_2, {}, 1.0, 1.0),
    # Dimensionless.
    units(0x0300, 0x5700, {(0x60A8, 0): 0}, 1.0, 1.0),
    # 0.1 counts/s and 10 counts/s^2 (Copley).
    units(0xFFB5_0300, 0x01B5_5700, {}, 0.1, 10.0),
    units(RPM, RPM_S, TURN, 20_000 / 60, 20_000 / 60),
    # A gear, and an invalid one.
    units(RPM, RPM_S, {**TURN, (0x6091, 1): 5, (0x6091, 2): 2}, 50_000 / 60, 50_000 / 60),
    units(RPM, RPM_S, {**TURN, (0x6091, 1): 0, (0x6091, 2): 0}, 20_000 / 60, 20_000 / 60),
    units(COUNTS, RPM_S, {**TURN, (0x6096, 1): 60, (0x6096, 2): 1}, 1.0, 20_000 / 60),
    (fed(100_000, 2), {(0x6085, 0): 12_000}, ""),
    (reports(TURN) | lacks(0x60A8, 0x60A9, 0x60AA), SPEEDS | RAMPS, UNREPORTED_UNITS),
    (reports(IN_RPM) | lacks(0x60AA), {(0x6085, 0): 30_000}, f"{ASSUMED}the unit of its sp"),
    (
        lacks(0x60A9) | reports({(0x6096, 1): 7, (0x6096, 2): 7}),
        SPEEDS | RAMPS,
        f"{ASSUMED}counts/s (0x60A9);",
    ),
    # Objects without a rule; a fixed heartbeat; objects with the value already.
    (refuses(RANGE, 0x605B, 0x1029, 0x1006), {}, "keeps its own 0x605B"),
    (lacks(0x1006, 0x1029, 0x6007), {}, "has no 0x6007"),
    (makes(0x6083, 10**6, 65_535), {(0x6083, 0): 65_535}, ""),
    (reports({(0x1017, 0): 200}) | refuses(READ_ONLY, 0x1017), {(0x1017, 0): 200}, ""),
    (reports({(0x605A, 0): 6}) | refuses(READ_ONLY, 0x605A), {(0x605A, 0): 6}, ""),
    # Unlisted modes are tried after switching off.
    (lacks(0x6502) | has(state="enabled"), {(0x6040, 0): 0}, ""),
    # Other sizes than in the standard; counters of less than 32 bits.
    (
        has(objects={at: bytes(n) for at, n in WIDTHS.items()})
        | has(refuses=lambda i, s, v: TOO_LONG * (len(v) != WIDTHS.get((i, s), len(v)))),
        {(0x605A, 0): 6, (0x6066, 0): 50, (0x60C2, 1): 20},
        "",
    ),
    # Received PDOs act at once if the drive refuses type 1 or 255.
    (no_types(b"\xff"), {(0x1400, 2): 0xFE, (0x1401, 2): 1}, ""),
    (no_types(b"\x01"), {(0x1400, 2): 0xFF, (0x1401, 2): 0xFF}, ""),
    # Unused process data.
    (reports({(0x1802, 1): 0x4000_0381}), {(0x1802, 1): 0xC000_0381, (0x1800, 3): 0}, ""),
    (lacks(0x60FD), {(0x1A00, 0): 2}, "has no digital inputs to map"),
    (
        has(refuses=lambda i, s, v: NOT_MAPPABLE * ((i, v) == (0x1A00, b"\x20\x00\xfd\x60"))),
        {(0x1A00, 0): 2},
        "has no digital inputs to map",
    ),
    (lacks(0x60F4), {(0x1A01, 0): 1}, "has no following error to map"),
    # Another program stopped the node.
    (has(nmt=0x04), {}, ""),
]


@pytest.mark.parametrize(("drive", "wanted", "missing"), TAKEN)
def test_drives_of_many_makers_are_set_up_and_move(
    drive: Change, wanted: Values, missing: str
) -> None:
    bench = DriveBench()
    change(bench.insertion, drive)
    bench.run(bench.drives.probe())
    bench.steps()
    assert {at: bench.insertion.value(*at) for at in wanted} == wanted
    reported = bench.drives.missing_optional_parts
    assert reported[0].startswith(f"insertion drive {missing}") if missing else reported == ()


def test_parameters_override_reported_units() -> None:
    bench = DriveBench(insertion_counts_per_turn=50_000.0, rotation_counts_per_turn=65536.0)
    change(bench.insertion, fed(360, 1))
    bench.rotation.set_objects({(0x60A9, 0): RPM, (0x60AA, 0): RPM_S})
    bench.configured()
    # 0.5 m/s^2 and 100 rad/s^2 in rpm/s.
    assert (bench.insertion.value(0x6085), bench.rotation.value(0x6085)) == (12_000, 955)


def test_homing_method_35_replaces_37() -> None:
    bench = DriveBench()
    change(bench.rotation, refuses(RANGE, 0x6098, but=b"\x23"))
    bench.steps()
    assert bench.rotation.value(0x6098) == 35


def test_axis_without_motor_needs_only_position_units() -> None:
    bench = DriveBench(insertion_drive="hand")
    bench.insertion.set_objects({(0x60A9, 0): 0x0001_0300, (0x60AA, 0): 0})
    bench.configured()
    assert bench.drives.missing_optional_parts == ()


def test_homing_slower_than_one_speed_unit_is_refused() -> None:
    bench = DriveBench(homing_speed=1e-5)
    bench.insertion.set_objects(IN_RPM)
    bench.configured()
    assert "homing at 1e-05/s is less than one speed unit" in bench.home().message
    bench.wait(20)
    assert (bench.state, bench.positions) == ("FAULT", (0, 0))


# ---- time limits and rounding --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parameter", "index", "wanted", "least", "most"),
    [
        ({}, 0x6085, 10**7, 5_000_001, 2 * 10**7),
        ({"insertion_following_error": 0.0005}, 0x6065, 10_000, 5001, 10_000),
        ({"insertion_max_torque": 0.802}, 0x6072, 802, 402, 1604),
    ],
)
def test_drive_may_round_a_bound_but_not_halve_it(
    parameter: dict[str, float], index: int, wanted: int, least: int, most: int
) -> None:
    for made, is_taken in ((least, True), (most, True), (least - 1, False), (most + 1, False)):
        bench = DriveBench(**parameter)
        change(bench.insertion, makes(index, wanted, made))
        if is_taken:
            assert bench.configured().insertion.value(index) == made
        else:
            assert f"was set to {wanted} at 0x{index:04X}" in bench.refusal()


# ---- software limits ----------------------------------------------------------------------------


def test_disabled_limits_fit_the_range_of_the_drive() -> None:
    bench = DriveBench()
    bench.insertion.refuses = lambda index, sub, value: (
        RANGE * (index == 0x607D and abs(int.from_bytes(value, "little", signed=True)) > 2**30)
    )
    bench.configured()
    assert [bench.insertion.value(0x607D, sub) for sub in (1, 2)] == [-(2**30), 2**30 - 1]


def test_drive_that_refuses_its_limits_is_not_switched_on() -> None:
    bench = DriveBench().homing()
    change(bench.insertion, refuses(RANGE, 0x607D))
    bench.wait(30)
    bench.reset()
    with pytest.raises(AxisError, match="insertion axis has no software limits yet"):
        bench.axes[0].power(True)
    assert not bench.enable().success
    bench.wait()
    assert bench.state == "FAULT"
    assert "refuses to write -20000 to 0x607D:1" in bench.status.fault


def test_slow_drives_with_few_heartbeats_accept_limits() -> None:
    bench = DriveBench().configured()
    bench.sdo_time, bench.insertion.beats, bench.rotation.beats = 0.09, False, False
    assert bench.home().success
    bench.wait(30)
    assert (bench.state, bench.is_homed()) == ("DISABLED", True), bench.status.fault
