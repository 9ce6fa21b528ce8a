"""Faults by one vocabulary: what goes wrong, on which part of the rig, from when, for how long."""

from __future__ import annotations

import dataclasses
import enum
import json
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from needle_common.errors import UserError


class Kind(enum.Enum):
    """Ways to go wrong."""

    OFF = "off"
    STUCK = "stuck"
    GARBAGE = "garbage"
    WRONG = "wrong"
    SLOW = "slow"
    INTERMITTENT = "intermittent"
    REORDERED = "reordered"
    DUPLICATED = "duplicated"


_LINK_KINDS = (Kind.OFF, Kind.SLOW, Kind.INTERMITTENT, Kind.REORDERED, Kind.DUPLICATED)
PROCESSES = ("device_driver", "plane_controller", "operator", "stereo_tracker", "joy_node")
TOPICS = (
    "/joy",
    "/device/hold",
    "/device/joint_trajectory",
    "/device/result",
    "/device/status",
    "/joint_states",
    "/needle/tip",
    "/needle/tip_pose",
    "/needle/controller_status",
)
SERVICES = (
    "/device/home",
    "/device/enable",
    "/device/reset",
    "/device/confirm_needle_out",
    "/device/retract",
    "/plane_controller/start",
)
BUS, ADAPTER, CAMERAS, CLOCK, PERSON, PARAMETERS = (
    "bus",
    "adapter",
    "cameras",
    "system clock",
    "person",
    "parameters",
)
DRIVES = ("insertion drive", "rotation drive")
STRANGER = "stranger on "
"""Begins the name of a part where a foreign node publishes or calls what is not its own."""
STRANGE_TOPICS = (
    "/device/hold",
    "/device/joint_trajectory",
    "/device/estop",
    "/joint_states",
    "/needle/tip",
    "/target_plane",
)
_STRANGE_SERVICES = (*SERVICES, "/device/stop", "/plane_controller/stop", "/device/enable off")

VOCABULARY: dict[str, tuple[Kind, ...]] = {
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
    **{STRANGER + name: (Kind.WRONG, Kind.GARBAGE) for name in STRANGE_TOPICS},
    **{STRANGER + name: (Kind.WRONG,) for name in _STRANGE_SERVICES},
}
"""What can go wrong with each part."""

_LATEST, _SHORTEST, _LONGEST = 9.0, 0.02, 4.0
_MOST = 6


@dataclasses.dataclass(frozen=True)
class Fault:
    """One fault of a schedule.

    Attributes
    ----------
    part : str
        One of `VOCABULARY`.
    kind : Kind
        One that it knows.
    at : float
        When it begins, from the start of the run [s].
    lasts : float
        How long [s]; what happens in a moment takes none of it.
    size : float
        How bad, 0..1: what that means depends on part and kind.
    """

    part: str
    kind: Kind
    at: float
    lasts: float
    size: float

    def __str__(self) -> str:
        """Return it in a line."""
        what = f"{self.part}: {self.kind.value}"
        return f"{what} ({self.size:.2f}), {self.at:.3f} s to {self.at + self.lasts:.3f} s"


def draw_schedule(generator: random.Random) -> list[Fault]:
    """Draw up to six faults, in the order in which they begin."""
    faults = []
    for _ in range(generator.randint(1, _MOST)):
        part = generator.choice(tuple(VOCABULARY))
        faults.append(
            Fault(
                part,
                generator.choice(VOCABULARY[part]),
                generator.uniform(0.0, _LATEST),
                # As many short as long ones.
                _SHORTEST * (_LONGEST / _SHORTEST) ** generator.random(),
                generator.random(),
            )
        )
    return sorted(faults, key=lambda fault: fault.at)


def write_schedule(path: Path, seed: int, faults: Sequence[Fault], why: str) -> None:
    """Write a seed and its faults as a file that `read_schedule` reads."""
    content: dict[str, Any] = {
        "seed": seed,
        "why": why,
        "faults": [{**dataclasses.asdict(one), "kind": one.kind.value} for one in faults],
    }
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def read_schedule(path: Path) -> tuple[int, list[Fault]]:
    """Return seed and faults of a file.

    Raises
    ------
    UserError
        If it is none of `write_schedule`.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        faults = [Fault(**{**one, "kind": Kind(one["kind"])}) for one in content["faults"]]
        seed = int(content["seed"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is no schedule: {error}") from error
    for fault in faults:
        if fault.kind not in VOCABULARY.get(fault.part, ()):
            raise UserError(f"{path}: {fault.part} cannot be {fault.kind.value}")
    return seed, faults
