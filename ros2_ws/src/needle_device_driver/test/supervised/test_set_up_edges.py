"""Set-up of a drive: time limits and rounding."""

from __future__ import annotations

import math
from functools import partial

import pytest

from .drive_bench import DriveBench


def stored(index: int, made: int, at: int, value: bytes) -> bytes:
    """Return the stored value."""
    return made.to_bytes(len(value), "little") if at == index else value


@pytest.mark.parametrize(("seconds", "is_off"), [(0.9, True), (1.1, False)])
def test_powered_drive_has_a_second_to_switch_off(seconds: float, is_off: bool) -> None:
    bench = DriveBench()
    bench.insertion.state = "enabled"
    bench.sdo_time = 0.02
    bench.delay_reaction(bench.insertion, seconds)
    reply = bench.configure()
    assert (reply.success, "does not switch off" in reply.message) == (is_off, not is_off)


@pytest.mark.parametrize(("seconds", "has_it"), [(0.4, True), (0.6, False)])
def test_drive_has_half_a_second_to_display_an_unlisted_mode(seconds: float, has_it: bool) -> None:
    bench = DriveBench()
    drive, due = bench.insertion, math.inf

    def refuses(index: int, _: int, __: bytes) -> int:
        nonlocal due
        due = bench.now + seconds if index == 0x6060 else due
        return 0

    def sending() -> None:
        drive.mode = 8 if bench.now >= due else 0

    drive.set_objects({(0x6502, 0): 0x225})
    drive.modes, drive.refuses, bench.bus.sending = set(), refuses, sending
    bench.sdo_time = 0.02
    reply = bench.configure()
    wanted = (True, False) if has_it else (False, True)
    assert (reply.success, "position mode (0x6060 = 8, 0x6061 = 0)" in reply.message) == wanted


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
        bench.insertion.stores = partial(stored, index, made)
        if is_taken:
            assert bench.configured().insertion.value(index) == made
        else:
            assert f"was set to {wanted} at 0x{index:04X}" in bench.refusal()
