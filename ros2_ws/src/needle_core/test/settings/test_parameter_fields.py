"""Parameters of a node: their types, bounds and choices, and their table."""

from __future__ import annotations

import dataclasses
import math

import pytest

from needle_core.errors import UserError
from needle_core.settings.parameter_fields import (
    check_fields,
    describe,
    fixed_parameter,
    from_values,
    parameter,
)


@dataclasses.dataclass(frozen=True)
class Parameters:
    """Numbers, a list and a text, as a node has them."""

    rate: float = parameter(30.0, unit="Hz", lower=1.0, upper=100.0, description="A rate.")
    count: int = parameter(3, unit="-", lower=1, upper=9, description="A count.")
    gains: tuple[float, ...] = fixed_parameter((1.0,), "-", "Gains.", 0.0, 9.0)
    law: str = parameter("mpc", unit="-", description="A law.", choices=("mpc", "pid"))

    def __post_init__(self) -> None:
        check_fields(self)


def test_parameters_are_applied_with_their_types_or_rejected_with_the_node() -> None:
    values = {"rate": 100.0, "count": 1, "gains": [0.0, 9.0], "law": "pid"}
    assert from_values(Parameters, values, "/rig") == Parameters(100.0, 1, (0.0, 9.0), "pid")
    for wrong, cause in (
        ({"rate": 100.1}, "rate = 100.1 Hz is outside [1, 100] Hz"),
        ({"rate": math.nan}, "rate = nan Hz is not finite"),
        ({"rate": 50}, "rate = 50 is not of type float (write 50.0)"),
        ({"count": True}, "count = True is of type bool, expected int"),
        ({"gains": [1.0, -0.1]}, "gains = -0.1 is outside [0, 9]"),
        ({"law": "pdi"}, "law = 'pdi' is not one of mpc, pid"),
        ({"raet": 20.0}, "unknown parameter 'raet' (did you mean 'rate'?)"),
        ({"x": 20.0}, "unknown parameter 'x' (known: count, gains, law, rate)"),
    ):
        with pytest.raises(UserError) as caught:
            from_values(Parameters, wrong, "/rig")
        assert str(caught.value) == f"/rig: {cause}"
    rate, _, _, _, gains, _, law, _ = describe(Parameters).splitlines()
    assert rate == "  rate: 30.0 Hz [1, 100]"
    assert gains == "  gains: [1.0] [0, 9] (fixed at start)"
    assert law == "  law: 'mpc' [mpc, pid]"
