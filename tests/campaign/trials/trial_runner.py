"""The runner of all trials: which there are, and a command that prints what came of each.

No ROS in here: a trial starts it where it has the network that it wants.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import random
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from needle_core.commands.cli import EXIT_DONE, run_command
from needle_core.commands.options import CommandParser
from needle_core.errors import UserError
from needle_core.process.ros_domain import own_domain
from needle_core.settings.bounds import check_bounds

Outcomes = Iterator[dict[str, Any]]


@dataclasses.dataclass(frozen=True)
class Trial:
    """One of many trials.

    Attributes
    ----------
    kind : str
        What is done in it.
    number : int
        Its number among those of its kind.
    rng : random.Random
        Of its kind.
    """

    kind: str
    number: int
    rng: random.Random

    def make_folder(self, parent: Path) -> Path:
        """Make a folder of its own for its logs."""
        folder = parent / f"{self.kind}_{self.number}"
        folder.mkdir()
        return folder

    def outcome(self, seen: Mapping[str, Any]) -> dict[str, Any]:
        """Return what came of it, signed with its kind and number."""
        return {"kind": self.kind, "number": self.number, **seen}


def trials_of(known: Sequence[str], chosen: Sequence[str], count: int, seed: int) -> list[Trial]:
    """Return the trials that a command line asks for, one kind after the other.

    Parameters
    ----------
    known, chosen : sequence of str
        Kinds that there are, and those that are wanted; all if none.
    count : int
        Trials of each.
    seed : int
        Of all that is drawn.

    Raises
    ------
    UserError
        If a kind is not known, or `count` is not at least 1.
    """
    check_bounds("count", count, 1, math.inf, "-")
    for kind in chosen:
        if kind not in known:
            raise UserError(f"{kind!r} is not one of {', '.join(known)}")
    return [
        Trial(kind, number, rng)
        for kind in chosen or known
        for rng in [random.Random(f"{seed} {kind}")]
        for number in range(count)
    ]


def run_trials(
    parser: CommandParser, outcomes: Callable[[argparse.Namespace, Path, int], Outcomes]
) -> int:
    """Run a command of trials, and print each outcome as one JSON object.

    Parameters
    ----------
    parser : CommandParser
        Knows the command's own words; `count` and `--seed` are added.
    outcomes : callable
        Yields them; it is given the command line, a folder for logs and a ROS_DOMAIN_ID.

    Returns
    -------
    int
        The exit code.
    """
    parser.add_argument("count", type=int, help="how many, of each kind")
    parser.add_argument("kinds", nargs="*", help="which of them; all if none")
    parser.add_argument("--seed", type=int, default=1)

    def run() -> int:
        given = parser.parse_args()
        with own_domain() as domain, tempfile.TemporaryDirectory(prefix="needle_trial_") as name:
            for outcome in outcomes(given, Path(name), domain):
                print(json.dumps(outcome), flush=True)
        return EXIT_DONE

    return run_command(run)
