"""What sim_rig can be told of the limits is what its supervisor keeps."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from needle_core.errors import OutOfBoundsError
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_sim.sim_rig_parameters import SimRigParameters

OWN = {field.name for field in dataclasses.fields(SimRigParameters)}
LIMITS = [field.name for field in dataclasses.fields(SafetyLimits) if field.name in OWN]


@pytest.mark.parametrize("name", LIMITS)
def test_a_limit_that_is_given_is_kept(name: str) -> None:
    default = getattr(SafetyLimits(), name)
    given = dataclasses.replace(SimRigParameters(), **{name: 0.9 * default}).limits
    assert given == dataclasses.replace(SafetyLimits(), **{name: 0.9 * default})


@pytest.mark.parametrize("name", ["max_speed", "max_step_length", "hold_timeout"])
def test_hard_caps_cannot_be_configured_away(name: str) -> None:
    too_much: dict[str, Any] = {name: 1.0}
    with pytest.raises(OutOfBoundsError, match=name):
        SimRigParameters(**too_much)
