"""Valid settings of a drive."""

from __future__ import annotations

import dataclasses

import pytest

from needle_core.errors import OutOfBoundsError, UserError
from needle_device_driver.cia402.backend import drive_settings
from needle_device_driver.parameters import DeviceDriverParameters

SETTINGS = drive_settings(DeviceDriverParameters(link="virtual", channel="test"), "insertion")


def test_node_id_range() -> None:
    for node_id in (1, 126):
        assert dataclasses.replace(SETTINGS, node_id=node_id).node_id == node_id
    for node_id in (0, 127):
        with pytest.raises(OutOfBoundsError, match="node_id"):
            dataclasses.replace(SETTINGS, node_id=node_id)


def test_supported_homing_methods() -> None:
    methods = {*range(1, 15), *range(17, 31), 33, 34, 35, 37}
    for method in range(-1, 40):
        if method in methods:
            assert dataclasses.replace(SETTINGS, homing_method=method).homing_method == method
        else:
            with pytest.raises(UserError, match=f"homing_method = {method} is not a CiA"):
                dataclasses.replace(SETTINGS, homing_method=method)
