"""The command line of `player`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

from needle_bags.format.topic_choice import TopicChoice
from needle_core.commands.options import CommandParser
from needle_core.errors import UserError
from needle_core.files.bag_directory import BagDirectory
from needle_core.settings.bounds import check_bounds
from needle_core.settings.parameter_files import absolute_name

_DESCRIPTION = """\
Play a bag: publish its messages with their recorded order, timing and quality of service. Late
subscribers receive the last message of a transient-local topic.

A rig never receives these messages. Commands (device/joint_trajectory), holds (device/hold),
emergency stops (device/estop), targets (target_plane, target_point, obstacles) and
/parameter_events are always published under /replay. If a rig is running (device/status has a
publisher), all topics are; if a rig starts later, the playback ends.
"""
_EPILOG = """\
To pause, to change the rate or to jump during playback, from another terminal:
  ros2 service call /player/pause std_srvs/srv/SetBool "{data: true}"
  ros2 param set /player rate 0.5
  ros2 param set /player seek 12.5       (seconds after the bag's first message)

examples:
  ros2 run needle_bags player bags/my_run
  ros2 run needle_bags player bags/my_run --rate 0.5 --start 10 --end 20 --loop
  ros2 run needle_bags player bags/my_run --topics needle/tip joint_states --paused
  ros2 run needle_bags player bags/my_run --regex '^/needle/' --exclude-regex pose
  ros2 run needle_bags player bags/my_run --ros-args -r /needle/tip:=/old/tip

A recorded /clock is played like any topic; with --clock, the recording time is published instead.

exit codes: 0 done or ended by Ctrl-C; 1 a rig started; 2 invalid arguments, or a bag that cannot be
played
"""
MIN_RATE = 0.001
MAX_RATE = 1000.0


@dataclasses.dataclass(frozen=True)
class PlayerOptions:
    """Options of the player.

    Attributes
    ----------
    bag : Path
        The bag's directory, or a file.
    rate : float
        Ratio of playback speed to recording speed.
    start, end : float
        Start and end, after the first message of the bag [s].
    topics : TopicChoice
        Topics to play.
    loop, paused : bool
        Whether to repeat at the end; whether to start paused.
    clock : float or None
        Rate of a /clock with the recording time [Hz].
    """

    bag: Path
    rate: float = 1.0
    start: float = 0.0
    end: float = math.inf
    topics: TopicChoice = dataclasses.field(default_factory=TopicChoice)
    loop: bool = False
    paused: bool = False
    clock: float | None = None

    def __post_init__(self) -> None:
        """Check the fields."""
        check_bounds("--rate", self.rate, MIN_RATE, MAX_RATE, "-")
        check_bounds("--start", self.start, 0.0, 1e9, "s")
        if self.clock is not None:
            check_bounds("--clock", self.clock, 0.1, 1000.0, "Hz")
        if not self.end > self.start:
            raise UserError(f"--end {self.end:g} s is not after --start {self.start:g} s")


def parse_options(arguments: Sequence[str]) -> PlayerOptions:
    """Return the options of a command line (without ROS arguments).

    Raises
    ------
    UserError
        If an option is invalid.
    """
    parser = CommandParser("player", _DESCRIPTION, _EPILOG)

    def add_regex(name: str, text: str) -> None:
        parser.add_argument(name, default="", metavar="REGEX", help=text)

    parser.add_argument("bag", type=Path, metavar="BAG", help="directory of the bag, or a file")
    parser.add_argument("--rate", type=float, default=1.0, metavar="R", help="speed factor")
    parser.add_argument("--start", type=float, default=0.0, metavar="S", help="start time [s]")
    parser.add_argument("--end", type=float, default=math.inf, metavar="S", help="end time [s]")
    parser.add_argument("--topics", nargs="+", default=[], metavar="T", help="only these topics")
    add_regex("--regex", "play topics whose name matches, and those of --topics")
    add_regex("--exclude-regex", "do not play topics whose name matches, except those of --topics")
    parser.add_argument("--loop", action="store_true", help="repeat until Ctrl-C")
    parser.add_argument("--paused", action="store_true", help="start paused")
    parser.add_argument(
        "--clock",
        nargs="?",
        type=float,
        const=40.0,
        metavar="HZ",
        help="publish the recording time on /clock, at 40 Hz or HZ, instead of a recorded one",
    )
    given = vars(parser.parse_args(arguments))
    names = tuple(map(absolute_name, given.pop("topics")))
    topics = TopicChoice(names, given.pop("regex"), given.pop("exclude_regex"))
    return PlayerOptions(**given, topics=topics)


def require_fits(options: PlayerOptions, contents: BagDirectory) -> None:
    """Raise a `UserError` if a topic or the start of the options is not in the bag."""
    known = contents.topics
    for name in options.topics.names:
        if name not in known:
            raise UserError(f"{name} is not in {options.bag}; it has {', '.join(known)}")
    seconds = (contents.end - contents.start) / 1e9
    if options.start > seconds:
        raise UserError(f"--start {options.start:g} s: {options.bag} ends at {seconds:.1f} s")
