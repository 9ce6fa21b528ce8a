"""Trials of the device driver against the emulated drives, each printed as one JSON object.

`python -m campaign.trials.drives.drive_trials steps 10000`, `... faults 50 cut_bus unplug`,
`... kills 50 simulated_operator`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from campaign.trials.drives.drive_faults import FAULTS, fault_trials
from campaign.trials.drives.drive_steps import random_steps
from campaign.trials.graph_kills import KILLED, kill_trials
from campaign.trials.listening_node import ros
from campaign.trials.trial_runner import Outcomes, run_trials, trials_of
from needle_core.commands.options import CommandParser

KINDS = {"steps": ("steps",), "faults": FAULTS, "kills": KILLED}


def main() -> int:
    """Run trials; returns the exit code."""
    parser = CommandParser("drive_trials", __doc__ or "", "")
    parser.add_argument("trial", choices=KINDS)
    parser.add_argument("--watchdog", type=float, help="faults: in place of the driver's own [s]")
    return run_trials(parser, _outcomes)


def _outcomes(given: argparse.Namespace, folder: Path, domain: int) -> Outcomes:
    trials = trials_of(KINDS[given.trial], given.kinds, given.count, given.seed)
    with ros(domain):
        if given.trial == "steps":
            yield random_steps(given.count, given.seed)
        elif given.trial == "faults":
            yield from fault_trials(folder, domain, trials, given.watchdog)
        else:
            yield from kill_trials(folder, domain, trials)


if __name__ == "__main__":
    sys.exit(main())
