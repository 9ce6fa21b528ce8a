"""The `simulated_operator` executable: keeps the hold in simulation, in a person's stead."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from typing import Any, TextIO

from needle_bringup.simulated_operator.component import (
    PROGRESS,
    SimulatedOperator,
    SimulatedOperatorParameters,
)
from needle_bringup.simulated_operator.progress import PROGRESS_FD, Progress, Shown
from needle_core.commands.cli import EXIT_INTERRUPTED
from needle_core.ros.main import run_component

HELP = """\
simulated_operator: stands in for the person who holds the needle's switch, in simulation.

Confirms that the needle is out, homes, enables, starts the controller, then keeps the hold until
the controller is DONE or in FAULT; releases and disables at the end, also on Ctrl-C. Draws the
progress. It acts only on a device that is alone and says in device/status that it is simulated: on
a rig that moves a real needle a person holds. A call that is not answered is made again after 1 s,
home and start only where the statuses do not show that they were taken.

Publishes   device/hold
Subscribes  needle/controller_status, device/status
Calls       device/confirm_needle_out, device/home, device/enable, plane_controller/start
Exit code   0 when the depth was reached, 1 when it was not, 2 when the rig did not get ready or for
            bad parameters, 130 when interrupted
"""


class _ProgressPort:
    """Shows the progress at the terminal."""

    def __init__(self) -> None:
        self._progress = Progress(_progress_stream())

    def open(self, arrive: Callable[[Any], None]) -> None:
        """Do nothing: nothing comes from there."""

    def send(self, batch: tuple[Shown, ...]) -> None:
        for shown in batch:
            self._progress.show(shown.insertion, shown.depth)
            self._progress.tell_wait(shown.waits_because)

    def close(self) -> None:
        self._progress.close("")


def _progress_stream() -> TextIO:
    """Return where the progress goes: stderr, or what the supervisor keeps open for it."""
    descriptor = os.environ.get(PROGRESS_FD)
    if descriptor is None:
        return sys.stderr
    return os.fdopen(int(descriptor), "w", encoding="utf-8", buffering=1)


def main() -> int:
    """Run the stand-in; returns its exit code."""
    return run_component(
        "simulated_operator",
        SimulatedOperatorParameters,
        lambda settings, name: SimulatedOperator(settings, name, time.monotonic()),
        help_text=HELP,
        ports=lambda _: {PROGRESS: _ProgressPort()},
        interrupted=EXIT_INTERRUPTED,
        shared_memory=False,
    )
