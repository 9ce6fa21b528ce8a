"""The recorder's parameters."""

from __future__ import annotations

import dataclasses

from needle_bringup.bag_writer import COMPRESSIONS
from needle_bringup.recording import RESERVE
from needle_common.parameter_fields import check_fields, parameter

# The part of the recorder's diagnostics that names the nodes whose parameters are in the bag.
PARAMETERS_OF = "parameters_of"


@dataclasses.dataclass(frozen=True)
class RecorderParameters:
    """What the recorder can be told."""

    bag: str = parameter(
        "",
        unit="-",
        description="The bag's directory; empty: a new time-stamped one here.",
        read_only=True,
    )
    calibration_file: str = parameter(
        "", unit="-", description="A file to keep in the bag as calibration.yaml.", read_only=True
    )
    run_info: str = parameter(
        "",
        unit="-",
        description="Text about the run to keep in the bag: YAML `key: value` lines or JSON.",
        read_only=True,
    )
    max_file_size: int = parameter(
        4_000_000_000,
        unit="B",
        lower=0,
        description="Messages in one data file, after which another is begun; 0: no bound.",
        read_only=True,
    )
    compression: str = parameter(
        "none",
        unit="-",
        choices=COMPRESSIONS,
        description="Of the data: zstd takes a third of a core for noisy images.",
        read_only=True,
    )
    reserve: int = parameter(
        RESERVE,
        unit="B",
        lower=0,
        description="Free space at which the recording ends; at most a tenth of the disk.",
        read_only=True,
    )

    def __post_init__(self) -> None:
        """Check the fields."""
        check_fields(self)
