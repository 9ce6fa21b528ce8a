"""The operator stand-in's parameters."""

from __future__ import annotations

import dataclasses

from needle_common.parameter_fields import check_fields, parameter


@dataclasses.dataclass(frozen=True)
class OperatorParameters:
    """Parameters of the operator stand-in; SI units."""

    speed_scale: float = parameter(
        1.0,
        unit="-",
        lower=0.0,
        upper=1.0,
        description="Share of the commanded speed that the held needle moves at.",
    )
    hold_rate: float = parameter(
        20.0,
        unit="Hz",
        lower=10.0,
        upper=100.0,
        read_only=True,
        description="Rate of device/hold; the device wants 10 Hz or more.",
    )
    wait_timeout: float = parameter(
        90.0,
        unit="s",
        lower=0.1,
        upper=3600.0,
        read_only=True,
        description="How long the rig may take to get ready, and each service to answer.",
    )
    stall_timeout: float = parameter(
        60.0,
        unit="s",
        lower=0.1,
        upper=3600.0,
        read_only=True,
        description="The hold is released when the needle has not moved on for this long.",
    )
    wait_for_recorder: bool = parameter(
        False,
        unit="-",
        read_only=True,
        description="Begin only when a node named recorder has the parameters of all nodes.",
    )

    def __post_init__(self) -> None:
        check_fields(self)
