"""The stand-in's parameters."""

from __future__ import annotations

import dataclasses

from needle_core.settings.parameter_fields import check_fields, fixed_parameter, parameter


@dataclasses.dataclass(frozen=True)
class SimulatedOperatorParameters:
    """Parameters of the person's stand-in; SI units."""

    speed_scale: float = parameter(
        1.0,
        unit="-",
        lower=0.0,
        upper=1.0,
        description="Share of the commanded speed that the held needle moves at.",
    )
    hold_rate: float = fixed_parameter(
        20.0, "Hz", "Rate of device/hold; the device wants 10 Hz or more.", 10.0, 100.0
    )
    wait_timeout: float = fixed_parameter(
        90.0,
        "s",
        "How long the rig may take to get ready, and each service to answer.",
        0.1,
        3600.0,
    )
    stall_timeout: float = fixed_parameter(
        30.0,
        "s",
        "The hold is released when the needle has not moved on for this long.",
        0.1,
        3600.0,
    )
    wait_for_recorder: bool = fixed_parameter(
        False, "-", "Begin only when a node named recorder has the parameters of all nodes."
    )

    def __post_init__(self) -> None:
        check_fields(self)
