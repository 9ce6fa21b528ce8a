"""Entries, PDOs, units, error codes and parameters."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import pytest
import yaml
from hypothesis import given, settings

from needle_core.errors import OutOfBoundsError, UserError
from needle_device_driver.cia402.backend import drive_settings
from needle_device_driver.device_driver import CycleTimes
from needle_device_driver.link import objects as od
from needle_device_driver.link.error_codes import describe_error
from needle_device_driver.parameters import DeviceDriverParameters

DRIVE = drive_settings(DeviceDriverParameters(), "insertion")


def test_entries_and_pdos_are_packed_little_endian() -> None:
    assert od.CONTROLWORD.mapping == 0x60400010
    assert od.LOWER_LIMIT.mapping == 0x607D0120
    assert od.COMMAND.pack(0x0F, 8) == b"\x0f\x00\x08"
    assert od.SET_POINT.pack(-2) == b"\xfe\xff\xff\xff"
    assert od.STATUS.unpack(b"\x37\x02\x08\x01\x00\x00\x00") == (0x0237, 8, 1)
    assert od.POSITION.unpack(b"\xff\xff\xff\xff\x02\x00\x00\x00") == (-1, 2)
    # Extra bytes of an entry are ignored; missing bytes are errors. A PDO may lack its last entry.
    assert od.STATUS.unpack(b"\x37\x02\x08") == (0x0237, 8)
    assert od.STATUSWORD.unpack(b"\x37\x02\x00\x00") == 0x0237
    with pytest.raises(ValueError, match="2 bytes, expected 4"):
        od.POSITION_ACTUAL.unpack(b"\x00\x00")
    for data in (b"", b"\x37\x02", bytes(6), bytes(8)):
        with pytest.raises(ValueError, match="PDO of"):
            od.STATUS.unpack(data)
    for entry, value in ((od.TARGET_POSITION, 2**31), (od.CONTROLWORD, -1)):
        with pytest.raises(OutOfBoundsError, match="outside"):
            entry.pack(value)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.floats(-0.2, 0.2), st.booleans())
def test_position_round_trip_is_accurate_to_half_a_count(position: float, reverse: bool) -> None:
    drive = dataclasses.replace(DRIVE, reverse=reverse)
    back = drive.position(drive.counts(position))
    assert abs(back - position) <= 0.5 / drive.counts_per_unit * (1 + 1e-9)


def test_reverse_drive_swaps_its_limits() -> None:
    reverse = dataclasses.replace(DRIVE, reverse=True)
    assert DRIVE.limits_counts == (-20_000, 4_020_000)
    assert reverse.limits_counts == (-4_020_000, 20_000)
    assert reverse.magnitude(0.005) == 100_000
    # A bound never becomes 0, which means "no bound".
    assert dataclasses.replace(DRIVE, counts_per_unit=1.0).magnitude(0.005) == 1


def test_invalid_settings_and_parameters_are_refused() -> None:
    parameters: list[dict[str, Any]] = [
        *({"insertion_node_id": node_id} for node_id in (0, 127)),
        *({"insertion_homing_method": method} for method in (0, 15, 16, 31, 36, 38)),
        {"rotation_node_id": 1},
        {"link": "usb"},
        {"channel": ""},
        {"insertion_drive": "foot"},
        {"bitrate": 123_456},
        *({f"insertion_{name}": 0.0} for name in ("counts_per_unit", "quick_stop_deceleration")),
        *({"max_speed": speed} for speed in (0.0, 0.006)),
        {"watchdog": 0.501},
    ]
    for changes in parameters:
        (name,) = changes
        with pytest.raises(UserError, match=name.removeprefix("insertion_")):
            DeviceDriverParameters(**changes)


def test_drive_bounds_follow_the_limits_and_the_example_is_valid() -> None:
    parameters = DeviceDriverParameters(max_depth=0.1, max_speed=0.002, max_turns=1.0)
    insertion, rotation = (drive_settings(parameters, axis) for axis in ("insertion", "rotation"))
    assert (insertion.lower, insertion.upper) == pytest.approx((-0.001, 0.101))
    assert (insertion.speed, rotation.speed) == (0.002, math.pi)
    assert rotation.upper == -rotation.lower == pytest.approx(2 * math.pi + 0.2)
    file = Path(__file__).resolve().parents[2] / "config" / "drives.yaml"
    values = yaml.safe_load(file.read_text("utf-8"))["device_driver"]["ros__parameters"]
    example = drive_settings(DeviceDriverParameters(**values), "rotation")
    link = DeviceDriverParameters(link="socketcand", channel="can0")
    assert link.link_name == "socketcand localhost:29536 can0"
    assert link.write_timeout == 0.05
    assert (example.max_torque, example.counts(2 * math.pi)) == (0.5, 65536)


def test_error_codes_have_texts() -> None:
    assert describe_error(0x8611) == "0x8611 following error"
    assert describe_error(0x4299) == "0x4299 temperature"
    assert describe_error(0x0001) == "0x0001 unknown error"


def test_late_cycles_are_counted() -> None:
    times = CycleTimes()
    for now in (1.0, 1.0299, 1.06, 1.08):
        times.begin(now)
    assert times.pop_figures() == {"late_cycles": "1", "longest_cycle_s": "0.0301"}
    assert times.pop_figures() == {"late_cycles": "1", "longest_cycle_s": "0.0000"}
