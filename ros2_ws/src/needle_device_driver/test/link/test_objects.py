"""Entries, PDOs, units and error words."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import pytest
import yaml
from hypothesis import given

from needle_core.errors import OutOfBoundsError, UserError
from needle_device_driver.cia402.drive_settings import DriveSettings
from needle_device_driver.link import objects as od
from needle_device_driver.link.emergency import describe_error
from needle_device_driver.parameters import DeviceDriverParameters


def settings(**changes: Any) -> DriveSettings:
    values: dict[str, Any] = {
        "node_id": 1,
        "counts_per_unit": 20_000_000.0,
        "reverse": False,
        "speed": 0.005,
        "acceleration": 0.05,
        "quick_stop_deceleration": 0.5,
        "homing_method": 17,
        "following_error": 0.0005,
        "following_error_time": 0.05,
        "max_torque": 0.0,
        "lower": -0.001,
        "upper": 0.201,
        "tolerance": 5e-6,
    }
    return DriveSettings(**(values | changes))


def test_mapping_words_are_index_subindex_and_bits() -> None:
    assert od.CONTROLWORD.mapping == 0x60400010
    assert od.MODE_OF_OPERATION.mapping == 0x60600008
    assert od.TARGET_POSITION.mapping == 0x607A0020
    assert od.LOWER_LIMIT.mapping == 0x607D0120


def test_pdos_are_packed_little_endian_in_their_order() -> None:
    assert od.COMMAND.pack(0x0F, 8) == b"\x0f\x00\x08"
    assert od.SET_POINT.pack(-2) == b"\xfe\xff\xff\xff"
    assert od.STATUS.unpack(b"\x37\x02\x08\x01\x00\x00\x00") == (0x0237, 8, 1)
    assert od.POSITION.unpack(b"\xff\xff\xff\xff\x02\x00\x00\x00") == (-1, 2)
    assert od.POSITION_ALONE.unpack(b"\xff\xff\xff\xff") == (-1,)


@pytest.mark.parametrize("data", [b"", b"\x37\x02\x08", bytes(8)])
def test_a_pdo_of_another_length_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="wanted 7"):
        od.STATUS.unpack(data)


@pytest.mark.parametrize(("entry", "value"), [(od.TARGET_POSITION, 2**31), (od.CONTROLWORD, -1)])
def test_a_value_that_an_entry_cannot_hold_is_refused(entry: od.Entry, value: int) -> None:
    with pytest.raises(OutOfBoundsError, match="outside"):
        entry.pack(value)


def test_a_short_answer_is_refused_and_a_long_one_cut() -> None:
    assert od.STATUSWORD.unpack(b"\x37\x02\x00\x00") == 0x0237
    with pytest.raises(ValueError, match="wanted 4"):
        od.POSITION_ACTUAL.unpack(b"\x00\x00")


@given(st.floats(-0.2, 0.2), st.booleans())
def test_a_position_comes_back_to_half_a_count(position: float, reverse: bool) -> None:
    drive = settings(reverse=reverse)
    back = drive.position(drive.counts(position))
    assert abs(back - position) <= 0.5 / drive.counts_per_unit * (1 + 1e-9)


@given(st.lists(st.floats(0.0, 1.2), min_size=1, max_size=200))
def test_rounding_never_accumulates(turns: list[float]) -> None:
    drive = settings(counts_per_unit=65536 / (2 * math.pi), lower=-1e3, upper=1e3)
    angle = 0.0
    for turn in turns:
        angle += turn
        assert abs(drive.counts(angle) - angle * drive.counts_per_unit) <= 0.5


def test_a_drive_that_counts_in_reverse_has_its_limits_the_other_way_round() -> None:
    assert settings().limits_counts == (-20_000, 4_020_000)
    assert settings(reverse=True).limits_counts == (-4_020_000, 20_000)
    assert settings(reverse=True).magnitude(0.005) == 100_000


def test_no_bound_becomes_the_zero_that_means_none() -> None:
    assert settings(counts_per_unit=1.0).magnitude(0.005) == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"node_id": 0},
        {"node_id": 127},
        {"counts_per_unit": 0.0},
        {"counts_per_unit": math.nan},
        {"speed": -1.0},
        {"quick_stop_deceleration": math.inf},
        {"homing_method": 36},
        {"lower": 1.0, "upper": 0.0},
    ],
)
def test_settings_that_no_drive_can_have_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(UserError):
        settings(**changes)


def test_error_codes_have_words() -> None:
    assert describe_error(0x8611) == "0x8611 following error"
    assert describe_error(0x4299) == "0x4299 temperature"
    assert describe_error(0x0001) == "0x0001 unknown error"


@pytest.mark.parametrize(
    "changes",
    [
        {"rotation_node_id": 1},
        {"link": "usb"},
        {"channel": ""},
        {"bitrate": 123_456},
        {"insertion_drive": "foot"},
        {"insertion_counts_per_unit": 0.0},
        {"max_speed": 0.006},
    ],
)
def test_parameters_that_no_rig_can_have_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(UserError, match=next(iter(changes))):
        DeviceDriverParameters(**changes)


def test_the_drives_bounds_follow_the_supervisors() -> None:
    parameters = DeviceDriverParameters(max_depth=0.1, max_speed=0.002, max_turns=1.0)
    insertion, rotation = parameters.drive("insertion"), parameters.drive("rotation")
    assert (insertion.lower, insertion.upper) == pytest.approx((-0.001, 0.101))
    assert insertion.speed == 0.002
    assert rotation.upper == -rotation.lower == pytest.approx(2 * math.pi + 0.2)


def test_the_example_configuration_is_one() -> None:
    file = Path(__file__).resolve().parents[2] / "config" / "drives.yaml"
    values = yaml.safe_load(file.read_text("utf-8"))["device_driver"]["ros__parameters"]
    parameters = DeviceDriverParameters(**values)
    assert parameters.drive("rotation").max_torque == 0.5
    assert parameters.drive("rotation").counts(2 * math.pi) == 65536
