"""The recorder's parameters."""

from __future__ import annotations

import dataclasses

from needle_bags.format.bag_writer import COMPRESSIONS
from needle_bags.format.topic_choice import TopicChoice
from needle_bags.recording.recent_messages import RecentMessages
from needle_bags.recording.recording import RESERVE
from needle_core.errors import UserError
from needle_core.settings.parameter_fields import check_fields, fixed_parameter
from needle_core.settings.parameter_files import absolute_name


@dataclasses.dataclass(frozen=True)
class RecorderParameters:
    """Parameters of the recorder."""

    bag: str = fixed_parameter(
        "", "-", "Directory of the bag; empty: a new time-stamped one in the working directory."
    )
    topics: tuple[str, ...] = fixed_parameter(
        (), "-", "Topics to record; with neither topics nor a regex, all topics.", texts=True
    )
    regex: str = fixed_parameter("", "-", "Also record topics whose name matches this expression.")
    exclude_regex: str = fixed_parameter(
        "/annotated_image$|/live_view/",
        "-",
        "Do not record topics whose name matches this expression, unless `topics` has them.",
    )
    snapshot_seconds: float = fixed_parameter(
        0.0,
        "s",
        "Keep the messages of this time, write them on request or on a fault; 0: write all.",
        0.0,
        3600.0,
    )
    snapshot_size: int = fixed_parameter(
        500_000_000,
        "B",
        "Maximum memory of the snapshot; with images it may be shorter than snapshot_seconds.",
        1_000_000,
        2**40,
    )
    calibration_file: str = fixed_parameter(
        "",
        "-",
        "Calibration to store in the bag; a tracker publishes its own.",
    )
    run_info: str = fixed_parameter(
        "", "-", "Text about the run to store in the bag: YAML `key: value` lines or JSON."
    )
    max_file_size: int = fixed_parameter(
        4_000_000_000,
        "B",
        "Maximum bytes of messages per data file; 0: no limit.",
        lower=0,
    )
    compression: str = fixed_parameter(
        "none",
        "-",
        "Compression of the data; zstd needs a third of a core for noisy images.",
        choices=COMPRESSIONS,
    )
    reserve: int = fixed_parameter(
        RESERVE,
        "B",
        "Free disk space at which the recording ends; at most a tenth of the disk.",
        lower=0,
    )

    def __post_init__(self) -> None:
        """Check the fields."""
        check_fields(self)
        if not all(isinstance(name, str) for name in self.topics):
            raise UserError(f"topics = {list(self.topics)} are not names")
        _ = self.choice

    @property
    def choice(self) -> TopicChoice:
        """The topics to record."""
        return TopicChoice(tuple(map(absolute_name, self.topics)), self.regex, self.exclude_regex)

    @property
    def recent(self) -> RecentMessages | None:
        """Empty snapshot buffer; None if everything is written."""
        if not self.snapshot_seconds:
            return None
        return RecentMessages(self.snapshot_seconds, self.snapshot_size)
