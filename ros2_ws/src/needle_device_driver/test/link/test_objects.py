"""Entries, PDOs, units, error codes and parameters."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from needle_core.errors import OutOfBoundsError, UserError
from needle_device_driver.cia402.backend import drive_settings
from needle_device_driver.device_driver import CycleTimes
from needle_device_driver.link import objects as od
from needle_device_driver.parameters import DeviceDriverParameters

DRIVE = drive_settings(DeviceDriverParameters(), "insertion")


def test_entries_and_pdos_are_packed_little_endian() -> None:
    assert od.LOWER_LIMIT.mapping == 0x607D0120
    assert od.SET_POINT.pack(-2) == b"\xfe\xff\xff\xff"
    assert od.STATUS.unpack(b"\x37\x02\x08\x01\x00\x00\x00") == (0x0237, 8, 1)
    # A PDO may lack its last entry; extra bytes of an entry are ignored.
    assert od.STATUS.unpack(b"\x37\x02\x08") == (0x0237, 8)
    assert od.STATUSWORD.unpack(b"\x37\x02\x00\x00") == 0x0237
    with pytest.raises(ValueError, match="2 bytes, expected 4"):
        od.POSITION_ACTUAL.unpack(b"\x00\x00")
    for data in (b"\x37\x02", bytes(6), bytes(8)):
        with pytest.raises(ValueError, match="PDO of"):
            od.STATUS.unpack(data)
    for entry, value in ((od.TARGET_POSITION, 2**31), (od.CONTROLWORD, -1)):
        with pytest.raises(OutOfBoundsError, match="outside"):
            entry.pack(value)


def test_position_is_rounded_to_the_nearest_count() -> None:
    counts = [DRIVE.counts(share / DRIVE.counts_per_unit) for share in (0.6, 1.4, -0.6)]
    assert counts == [1, 1, -1]


def test_reverse_drive_swaps_its_limits() -> None:
    reverse = dataclasses.replace(DRIVE, reverse=True)
    assert DRIVE.limits_counts == (-20_000, 4_020_000)
    assert reverse.limits_counts == (-4_020_000, 20_000)
    assert reverse.magnitude(0.005) == 100_000
    # A bound never becomes 0, which means "no bound".
    assert dataclasses.replace(DRIVE, counts_per_unit=1.0).magnitude(0.005) == 1


@pytest.mark.parametrize(
    ("parameter", "value"),
    [
        ("insertion_homing_method", 36),
        ("rotation_node_id", 1),
        ("insertion_node_id", 0),
        # The id of the computer.
        ("rotation_node_id", 127),
        ("insertion_counts_per_turn", -0.1),
        ("insertion_following_error_time", 0.0009),
        ("insertion_following_error_time", 10.1),
        ("insertion_max_torque", -0.1),
        ("insertion_max_torque", 5.1),
        ("channel", ""),
        ("insertion_drive", "foot"),
        ("bitrate", 123_456),
    ],
)
def test_invalid_parameter_is_refused(parameter: str, value: Any) -> None:
    with pytest.raises(UserError, match=parameter.removeprefix("insertion_")):
        DeviceDriverParameters(**{parameter: value})


def test_parameters_of_a_drive_at_their_bounds() -> None:
    given = {"node_id": 126, "following_error_time": 10.0, "max_torque": 5.0}
    named = {f"rotation_{name}": value for name, value in given.items()}
    drive = drive_settings(DeviceDriverParameters(**named), "rotation")
    assert {name: getattr(drive, name) for name in given} == given
    assert drive_settings(DeviceDriverParameters(), "rotation").node_id == 2


def test_homing_methods_are_those_of_cia402_to_a_switch_an_index_pulse_or_here() -> None:
    def is_known(method: int) -> bool:
        with contextlib.suppress(UserError):
            return bool(dataclasses.replace(DRIVE, homing_method=method))
        return False

    known = [method for method in range(-5, 40) if is_known(method)]
    assert known == [*range(1, 15), *range(17, 31), 33, 34, 35, 37]


def test_drive_bounds_follow_the_limits() -> None:
    parameters = DeviceDriverParameters(max_depth=0.1, max_speed=0.002, max_turns=1.0)
    insertion, rotation = (drive_settings(parameters, axis) for axis in ("insertion", "rotation"))
    assert (insertion.lower, insertion.upper) == pytest.approx((-0.001, 0.101))
    assert (insertion.speed, rotation.speed) == (0.002, math.pi)
    assert rotation.upper == -rotation.lower == pytest.approx(2 * math.pi + 0.2)


def test_example_parameters_are_valid() -> None:
    file = Path(__file__).resolve().parents[2] / "config" / "drives.yaml"
    values = yaml.safe_load(file.read_text("utf-8"))["device_driver"]["ros__parameters"]
    example = drive_settings(DeviceDriverParameters(**values), "rotation")
    assert (example.max_torque, example.counts(2 * math.pi)) == (0.5, 65536)


def test_late_cycles_are_counted() -> None:
    times = CycleTimes()
    for now in (1.0, 1.0299, 1.06, 1.08):
        times.begin(now)
    assert times.pop_figures() == {"late_cycles": "1", "longest_cycle_s": "0.0301"}
    assert times.pop_figures() == {"late_cycles": "1", "longest_cycle_s": "0.0000"}
