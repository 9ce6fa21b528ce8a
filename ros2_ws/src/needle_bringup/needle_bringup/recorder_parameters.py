"""The recorder's parameters."""

from __future__ import annotations

import dataclasses

from needle_bringup.bag_writer import COMPRESSIONS
from needle_bringup.recording import RESERVE
from needle_common.parameter_fields import check_fields, fixed_parameter

# The part of the recorder's diagnostics that names the nodes whose parameters are in the bag.
PARAMETERS_OF = "parameters_of"


@dataclasses.dataclass(frozen=True)
class RecorderParameters:
    """What the recorder can be told."""

    bag: str = fixed_parameter("", "-", "The bag's directory; empty: a new time-stamped one here.")
    calibration_file: str = fixed_parameter(
        "", "-", "A file to keep in the bag as calibration.yaml."
    )
    run_info: str = fixed_parameter(
        "", "-", "Text about the run to keep in the bag: YAML `key: value` lines or JSON."
    )
    max_file_size: int = fixed_parameter(
        4_000_000_000,
        "B",
        "Messages in one data file, after which another is begun; 0: no bound.",
        lower=0,
    )
    compression: str = fixed_parameter(
        "none",
        "-",
        "Of the data: zstd takes a third of a core for noisy images.",
        choices=COMPRESSIONS,
    )
    reserve: int = fixed_parameter(
        RESERVE,
        "B",
        "Free space at which the recording ends; at most a tenth of the disk.",
        lower=0,
    )

    def __post_init__(self) -> None:
        """Check the fields."""
        check_fields(self)
