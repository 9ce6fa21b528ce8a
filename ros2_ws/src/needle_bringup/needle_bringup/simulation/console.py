"""A simulated rig in real time and the console's page on it: scripts/console."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from needle_bringup.simulation.console_graph import run_console_graph
from needle_bringup.simulation.console_options import LOOPBACK, ConsoleOptions, parse_console
from needle_bringup.simulation.rig_configuration import command_line_parameters
from needle_core.commands.cli import EXIT_INTERRUPTED, EXIT_MISSED, run_command
from needle_core.process.end_request import EndRequest
from needle_core.settings.parameter_files import Parameters

if TYPE_CHECKING:
    from needle_core.component import Component, RealPort

# As often as a page shows them [Hz].
_CAMERA_RATE = 10.0
_SLICE = 0.2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `console`; returns its exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    return run_command(lambda: console(parse_console(words)))


def console(options: ConsoleOptions) -> int:
    """Run rig and page until a signal comes.

    Parameters
    ----------
    options : ConsoleOptions
        What to run.

    Returns
    -------
    int
        130 after a signal, 1 where a component ended before.

    Raises
    ------
    UserError
        Where something is missing or a port is taken.
    """
    if options.rig.graph:
        with EndRequest() as end:
            return run_console_graph(options, rig_parameters(options), end)
    # Small matrices: threads only get in each other's way. It counts for what is loaded from here.
    os.environ.update({"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"})
    from needle_console.console import PAGE, Console  # noqa: PLC0415
    from needle_console.console_parameters import ConsoleParameters  # noqa: PLC0415
    from needle_console.page.web_server import ServedPagePort  # noqa: PLC0415
    from needle_core.runners.paced import PacedRunner  # noqa: PLC0415

    settings = ConsoleParameters(address=LOOPBACK, port=options.port, hold_port=options.port + 1)
    with EndRequest() as end:
        desk = ServedPagePort(settings)
        rig, ports = _make_rig(rig_parameters(options))
        components = [*rig, Console(settings)]
        runner = PacedRunner(components, options.rig.seed, ports={PAGE: desk, **ports})
        with contextlib.closing(runner):
            print(f"http://{LOOPBACK}:{options.port}/   (Ctrl-C ends all)", flush=True)
            while not end.wanted:
                if runner.run(_SLICE):
                    (name, ended), *_ = runner.exits.items()
                    print(f"error: {name} ended: {ended.text}", file=sys.stderr)
                    return EXIT_MISSED
                desk.set_lag(runner.lag)
        return EXIT_INTERRUPTED


def rig_parameters(options: ConsoleOptions) -> Parameters:
    """Return the parameters of the rig, by its nodes' names."""
    parameters = command_line_parameters(options.rig, Path())
    parameters["sim_rig"]["camera_rate"] = _CAMERA_RATE
    return parameters


def _make_rig(parameters: Parameters) -> tuple[list[Component], dict[str, RealPort]]:
    """Return the rig, and its ports to other processes."""
    from needle_bringup.simulation.virtual_run import make_rig  # noqa: PLC0415

    if parameters["sim_rig"]["level"] == "tip":
        return make_rig(parameters), {}
    from needle_bringup.simulation.vision import (  # noqa: PLC0415
        EYES,
        DistantTracker,
        EyesProcess,
    )
    from needle_sim.camera_sensor import DistantCameras  # noqa: PLC0415

    rig = make_rig(parameters, DistantCameras, lambda _: DistantTracker())
    return rig, {EYES: EyesProcess(parameters)}


if __name__ == "__main__":
    sys.exit(main())
