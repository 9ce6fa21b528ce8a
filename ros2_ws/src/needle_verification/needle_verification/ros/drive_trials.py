"""Trials of the device driver against the emulated drives, each printed as one JSON object.

`python -m needle_verification.ros.drive_trials steps 10000`, `... faults 50 cut_bus unplug`,
`... kills 50 simulated_operator`, `... two_rigs 50`, `... nuisances 5 points flood` (5 s of each),
`... fuzz 900` (seconds).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import rclpy

from needle_common.commands.cli import EXIT_DONE, run_command
from needle_common.commands.options import CommandParser
from needle_common.errors import UserError
from needle_common.process.ros_domain import own_domain
from needle_verification.ros.drive_faults import FAULTS, fault_trials
from needle_verification.ros.drive_steps import random_steps
from needle_verification.ros.fuzz_trials import fuzz_trials
from needle_verification.ros.graph_kills import KILLED, kill_trials
from needle_verification.ros.nuisance import NUISANCE_KINDS
from needle_verification.ros.nuisance_trials import nuisance_trials
from needle_verification.ros.two_rigs import two_rigs_trials

TRIALS = ("steps", "faults", "kills", "two_rigs", "nuisances", "fuzz")
KINDS = {"faults": FAULTS, "kills": KILLED, "nuisances": NUISANCE_KINDS}


def main() -> int:
    """Run trials; returns the exit code."""
    parser = CommandParser("drive_trials", __doc__ or "", "")
    parser.add_argument("trial", choices=TRIALS)
    parser.add_argument("count", type=int)
    parser.add_argument("kinds", nargs="*", help="which faults, or which nodes; all if none")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--watchdog", type=float, help="faults: in place of the driver's own [s]")

    def run() -> int:
        given = parser.parse_args()
        with own_domain() as domain, tempfile.TemporaryDirectory(prefix="needle_trial_") as name:
            rclpy.init(args=[], domain_id=domain)
            try:
                for outcome in _outcomes(given, Path(name), domain):
                    print(json.dumps(outcome), flush=True)
            finally:
                rclpy.try_shutdown()
        return EXIT_DONE

    return run_command(run)


def _outcomes(given: argparse.Namespace, folder: Path, domain: int) -> Iterator[dict[str, Any]]:
    known = KINDS.get(given.trial, ())
    kinds = [_known(kind, known) for kind in given.kinds] or known
    if given.trial == "steps":
        yield random_steps(folder, domain, given.count, given.seed)
    elif given.trial == "faults":
        yield from fault_trials(
            folder, domain, kinds, given.count, given.seed, watchdog=given.watchdog
        )
    elif given.trial == "nuisances":
        yield from nuisance_trials(folder, domain, kinds, float(given.count))
    elif given.trial == "fuzz":
        yield from fuzz_trials(folder, domain, float(given.count), given.seed)
    elif given.trial == "two_rigs":
        yield from two_rigs_trials(folder, domain, given.count, given.seed)
    else:
        yield from kill_trials(folder, domain, kinds, given.count, given.seed)


def _known(kind: str, known: Sequence[str]) -> str:
    if kind not in known:
        raise UserError(f"{kind!r} is not one of {', '.join(known)}")
    return kind


if __name__ == "__main__":
    sys.exit(main())
