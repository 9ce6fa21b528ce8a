"""Vocabulary of faults, and schedules of faults: part of the rig, kind, begin, duration, size."""

from __future__ import annotations

import dataclasses
import enum
import json
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from needle_core.errors import UserError


class Kind(enum.Enum):
    """Kinds of faults."""

    OFF = "off"
    STUCK = "stuck"
    GARBAGE = "garbage"
    WRONG = "wrong"
    SLOW = "slow"
    INTERMITTENT = "intermittent"
    REORDERED = "reordered"
    DUPLICATED = "duplicated"


class Moment(enum.Enum):
    """Moment of a run that a fault may follow."""

    START = "start"
    ADAPTER_OPENED = "adapter opened"
    HOMING = "homing"
    HOLDING = "holding"
    STEERING = "steering"
    PRESSED = "pressed"
    COMMAND = "command"
    MOVING = "moving"
    RELEASED = "released"
    FAULT = "fault"
    DONE = "done"


_LINK_KINDS = (Kind.OFF, Kind.SLOW, Kind.INTERMITTENT, Kind.REORDERED, Kind.DUPLICATED)
PROCESSES = ("device_driver", "plane_controller", "operator", "stereo_tracker", "joy_node")
TOPICS = (
    "/joy", "/device/hold", "/device/joint_trajectory", "/device/result", "/device/status",
    "/joint_states", "/needle/tip", "/needle/tip_pose", "/needle/controller_status",
)  # fmt: skip
SERVICES = (
    "/device/home", "/device/enable", "/device/reset", "/device/confirm_needle_out",
    "/device/retract", "/plane_controller/start",
)  # fmt: skip
BUS, ADAPTER, CAMERAS, CLOCK = "bus", "adapter", "cameras", "system clock"
PERSON, PARAMETERS = "person", "parameters"
SECOND_PERSON = "second person"
"""Person with a separate joystick and operator node: keeps it pressed, retracts, presses at random,
loses the joystick during a press."""
CONSOLE, PAGE, PAGE_LINE = "console", "page", "page line"
"""With a fault of one of these, the operator holds by a page of the console, not the joystick."""
RECORDER, DISK = "recorder", "disk"
"""With a fault of one of these, the rig has a recorder with a disk."""
DRIVES = ("insertion drive", "rotation drive")
ROGUE = "stranger on "
"""Prefix of parts on which a foreign node publishes, or that it calls."""
ROGUE_TOPICS = (
    "/device/hold", "/device/joint_trajectory", "/device/estop", "/joint_states", "/needle/tip",
    "/target_plane",
)  # fmt: skip
FLOOD = "flood"
"""A foreign node that publishes 5,000 messages per second; `size` selects the topic."""
_ROGUE_SERVICES = (*SERVICES, "/device/stop", "/plane_controller/stop", "/device/enable off")

_DRAWN_TOGETHER: dict[str, tuple[Kind, ...]] = {
    **dict.fromkeys(PROCESSES, (Kind.OFF, Kind.STUCK, Kind.SLOW)),
    **dict.fromkeys(TOPICS, _LINK_KINDS),
    **dict.fromkeys(SERVICES, (Kind.OFF, Kind.SLOW, Kind.DUPLICATED)),
    BUS: _LINK_KINDS,
    ADAPTER: (Kind.OFF,),
    **dict.fromkeys(DRIVES, (Kind.OFF, Kind.STUCK, Kind.GARBAGE, Kind.SLOW)),
    CAMERAS: (Kind.OFF, Kind.STUCK, Kind.WRONG, Kind.SLOW, Kind.GARBAGE),
    CLOCK: (Kind.WRONG, Kind.SLOW),
    PERSON: (Kind.WRONG, Kind.STUCK, Kind.INTERMITTENT, Kind.OFF),
    PARAMETERS: (Kind.WRONG, Kind.GARBAGE),
    **{ROGUE + name: (Kind.WRONG, Kind.GARBAGE) for name in ROGUE_TOPICS},
    **{ROGUE + name: (Kind.WRONG,) for name in _ROGUE_SERVICES},
}
_DRAWN_ALONE: dict[str, tuple[Kind, ...]] = {
    SECOND_PERSON: (Kind.STUCK, Kind.WRONG, Kind.INTERMITTENT, Kind.OFF),
    CONSOLE: (Kind.OFF, Kind.STUCK, Kind.SLOW),
    PAGE: (Kind.OFF, Kind.STUCK, Kind.GARBAGE, Kind.DUPLICATED),
    PAGE_LINE: (Kind.OFF, Kind.SLOW, Kind.INTERMITTENT),
    FLOOD: (Kind.WRONG, Kind.GARBAGE),
    RECORDER: (Kind.OFF, Kind.STUCK, Kind.SLOW),
    DISK: (Kind.OFF, Kind.STUCK, Kind.GARBAGE, Kind.SLOW),
}
VOCABULARY = {**_DRAWN_TOGETHER, **_DRAWN_ALONE}
"""Kinds of faults by part."""

_LATEST, _SHORTEST, _LONGEST = 6.0, 0.02, 4.0
# Delay after a moment other than the start [s], and number of its occurrence.
_SOONEST_AFTER, _LATEST_AFTER = 0.001, 1.0
_TIMES = (1, 1, 2, 3)
_MOST = 6
# Probability of a fault of each part that is drawn alone.
_ALONE = 1.0 / 8.0


@dataclasses.dataclass(frozen=True)
class Fault:
    """One fault of a schedule.

    Attributes
    ----------
    part : str
        One of `VOCABULARY`.
    kind : Kind
        One of the part's kinds.
    at : float
        Begin, from `after` [s].
    lasts : float
        Duration [s]; ignored for an instantaneous fault.
    size : float
        Severity 0..1; its meaning depends on part and kind.
    after : Moment
        Moment that it follows.
    nth : int
        Number of the moment's occurrence, from 1.
    """

    part: str
    kind: Kind
    at: float
    lasts: float
    size: float
    after: Moment = Moment.START
    nth: int = 1

    def __str__(self) -> str:
        """Return the fault as one line."""
        what = f"{self.part}: {self.kind.value} ({self.size:.2f})"
        when = f"{self.at:.3f} s after {self.after.value} {self.nth}"
        return f"{what}, {when}, for {self.lasts:.3f} s"


def rogue_topic(fault: Fault) -> str:
    """Return the topic on which a foreign node publishes during a fault; empty if none."""
    if fault.part == FLOOD:
        return ROGUE_TOPICS[int(fault.size * len(ROGUE_TOPICS))]
    name = fault.part.removeprefix(ROGUE)
    return name if name in ROGUE_TOPICS and name != fault.part else ""


def draw_schedule(seed: int) -> list[Fault]:
    """Draw up to six faults of the parts drawn together, and at most one of each other part.

    Half of them follow the start, the others any moment. Each part drawn alone has its own random
    stream, so that a new part adds its fault and changes no other.
    """
    generator = random.Random(f"faults of {seed}")
    faults = []
    for _ in range(generator.randint(1, _MOST)):
        faults.append(_draw(generator, generator.choice(tuple(_DRAWN_TOGETHER))))
    for part in _DRAWN_ALONE:
        own = random.Random(f"{part} of {seed}")
        if own.random() < _ALONE:
            faults.append(_draw(own, part))
    return faults


def _draw(generator: random.Random, part: str) -> Fault:
    fault = Fault(
        part,
        generator.choice(VOCABULARY[part]),
        generator.uniform(0.0, _LATEST),
        _log_uniform(generator, _SHORTEST, _LONGEST),
        generator.random(),
    )
    if generator.random() >= 0.5:
        return fault
    return dataclasses.replace(
        fault,
        at=_log_uniform(generator, _SOONEST_AFTER, _LATEST_AFTER),
        after=generator.choice(tuple(Moment)),
        nth=generator.choice(_TIMES),
    )


def _log_uniform(generator: random.Random, shortest: float, longest: float) -> float:
    return float(shortest * (longest / shortest) ** generator.random())


def write_schedule(path: Path, seed: int, faults: Sequence[Fault], why: str) -> None:
    """Write a seed and its faults as a file that `read_schedule` reads."""
    listed = [
        {**dataclasses.asdict(one), "kind": one.kind.value, "after": one.after.value}
        for one in faults
    ]
    content: dict[str, Any] = {"seed": seed, "why": why, "faults": listed}
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def read_schedule(path: Path) -> tuple[int, list[Fault]]:
    """Return seed and faults of a file.

    Raises
    ------
    UserError
        If the file is not a valid schedule.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        faults = [
            Fault(**{**one, "kind": Kind(one["kind"]), "after": Moment(one["after"])})
            for one in content["faults"]
        ]
        seed = int(content["seed"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is no schedule: {error}") from error
    for fault in faults:
        if fault.kind not in VOCABULARY.get(fault.part, ()):
            raise UserError(f"{path}: {fault.part} cannot be {fault.kind.value}")
    return seed, faults
