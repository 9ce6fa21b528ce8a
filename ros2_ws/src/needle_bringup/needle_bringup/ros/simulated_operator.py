"""The `simulated_operator` executable: presses the hold of a simulated rig."""

from __future__ import annotations

import os
import sys
import time
from typing import TextIO

from needle_bringup.simulated_operator.component import (
    PROGRESS,
    SimulatedOperator,
    SimulatedOperatorParameters,
)
from needle_bringup.simulated_operator.progress import PROGRESS_FD, Progress
from needle_core.commands.cli import EXIT_INTERRUPTED
from needle_core.ros.main import run_component

HELP = """\
simulated_operator: operates the hold-to-run switch of a simulated rig.

Confirms that the needle is out, homes, enables, starts the controller, and presses the hold until
the controller is DONE or in FAULT; then, and on Ctrl-C, it releases the hold and disables the
device. Shows the progress. It acts only if exactly one device reports in device/status that it is
simulated: on a real rig a person holds the switch. It repeats an unanswered call after 1 s; home
and start only if the status does not show that they were accepted.

Publishes   device/hold
Subscribes  needle/controller_status, device/status
Calls       device/confirm_needle_out, device/home, device/enable, plane_controller/start

Exit codes: 0 depth reached; 1 depth not reached; 2 the rig did not get ready, or a parameter is
invalid; 130 interrupted
"""


def _progress_stream() -> TextIO:
    """Return stderr, or the stream that the parent process keeps open."""
    descriptor = os.environ.get(PROGRESS_FD)
    if descriptor is None:
        return sys.stderr
    return os.fdopen(int(descriptor), "w", encoding="utf-8", buffering=1)


def main() -> int:
    """Run the node; return its exit code."""
    return run_component(
        "simulated_operator",
        SimulatedOperatorParameters,
        lambda settings, name: SimulatedOperator(settings, name, time.monotonic()),
        help_text=HELP,
        ports=lambda _: {PROGRESS: Progress(_progress_stream())},
        interrupted=EXIT_INTERRUPTED,
        shared_memory=False,
    )
