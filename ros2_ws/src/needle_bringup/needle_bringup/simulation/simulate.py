"""`simulate`: runs the simulated rig, records it and writes the report."""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from needle_bringup.simulated_operator.progress import PROGRESS_FD
from needle_bringup.simulation.node_graph import (
    OPERATOR,
    PARAMETERS,
    NodeFailedError,
    NodeGraph,
    wait_for,
)
from needle_bringup.simulation.rig_configuration import (
    PACKAGES,
    command_line_parameters,
    contradictions,
    merge,
    nodes_of,
    refuse_reserved,
    run_info,
    write_parameters,
)
from needle_bringup.simulation.simulate_options import SimulateOptions, command_of, parse
from needle_bringup.workplace import checkout
from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, JsonValue, run_command, write_json
from needle_core.errors import UserError
from needle_core.process.discovery import clean_environment
from needle_core.process.ros_domain import reserve_domain_id
from needle_core.process.shutdown import ShutdownFlag
from needle_core.settings.parameter_files import Parameters, read_parameters

METADATA = "metadata.yaml"
SUMMARY = "summary.json"
REPORT = "report.html"
POLL = 0.05
# Environment variable set by scripts/simulate: start of the command, seconds since the epoch.
STARTED_AT = "NEEDLE_STARTED_AT"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `simulate`; return its exit code."""
    if STARTED_AT in os.environ:
        _end_with_parent()
    argv = sys.argv[1:] if arguments is None else arguments
    return run_command(lambda: simulate(parse(argv)))


def simulate(options: SimulateOptions) -> int:
    """Run one simulation with the given options.

    Parameters
    ----------
    options : SimulateOptions
        Options of the command line.

    Returns
    -------
    int
        0 if the needle converged, 1 if it missed.

    Raises
    ------
    UserError
        If an input is invalid or missing, or a node failed.
    KeyboardInterrupt
        After an interrupt, when all parts have ended.
    """
    if options.graph:
        clean_environment(own_graph=True)
    started_at = float(os.environ.get(STARTED_AT) or time.time())
    given: Parameters = {}
    if options.params is not None:
        given = read_parameters(options.params, nodes_of(options))
        refuse_reserved(options.params, given, options)
    # From here on, signals are checked between steps; during the report they raise immediately.
    end = ShutdownFlag()
    bag = _make_folder(options)
    try:
        parameters = merge(command_line_parameters(options, bag), given)
        for line in contradictions(parameters, nodes_of(options)):
            print(f"warning: {line}", file=sys.stderr)
        parameters = {node: parameters[node] for node in nodes_of(options)}
        with end:
            if options.graph:
                _run_graph(options, parameters, bag, end)
            else:
                write_parameters(bag / PARAMETERS, parameters)
                _run_components(options, parameters, bag, end)
        _check(end)
        return _report(options, bag, started_at)
    except NodeFailedError as error:
        # Keep the logs if a node failed.
        if error.is_bad_input:
            shutil.rmtree(bag, ignore_errors=True)
        raise
    except (UserError, KeyboardInterrupt):
        if not (bag / METADATA).exists():
            shutil.rmtree(bag, ignore_errors=True)
        raise


def _check(end: ShutdownFlag) -> None:
    if end.requested:
        raise KeyboardInterrupt


def _run_components(
    options: SimulateOptions, parameters: Parameters, bag: Path, end: ShutdownFlag
) -> None:
    """Run the rig in this process until the operator ends."""
    # Import late: compiled code loads slowly, and with --graph only the nodes need it.
    from needle_bringup.simulation import virtual_run  # noqa: PLC0415

    components = virtual_run.make_components(parameters)
    components += [virtual_run.own_component(name) for name in options.component]
    print(f"recording into {shown(bag)}", file=sys.stderr)
    virtual_run.run_virtually(
        components,
        bag,
        seed=options.seed,
        run_info={**run_info(options), "command": command_of(options)},
        real_time_factor=options.real_time_factor,
        check=lambda: _check(end),
    )


def _run_graph(
    options: SimulateOptions, parameters: Parameters, bag: Path, end: ShutdownFlag
) -> None:
    """Run the rig as ROS nodes until the operator ends."""
    with reserve_domain_id() as domain:
        print(f"recording into {shown(bag)} (ROS_DOMAIN_ID {domain})", file=sys.stderr)
        # The nodes write log files; only the operator's progress is shown in the terminal.
        progress = os.dup(sys.stderr.fileno())
        variables = {"ROS_DOMAIN_ID": str(domain), PROGRESS_FD: str(progress)}
        graph = NodeGraph(bag, parameters, **variables)
        try:
            for name in nodes_of(options):
                _check(end)
                graph.start(PACKAGES[name], name, [progress] if name == OPERATOR else [])
            _await_operator(graph, end)
        finally:
            os.close(progress)
            graph.stop()


def _await_operator(graph: NodeGraph, end: ShutdownFlag) -> None:
    operator = graph.nodes[OPERATOR]
    while operator.exit_code is None:
        _check(end)
        graph.check()
        wait_for([operator], POLL)
    graph.check()
    if operator.exit_code not in (EXIT_DONE, EXIT_MISSED):
        raise NodeFailedError(operator)


def _report(options: SimulateOptions, bag: Path, started_at: float) -> int:
    """Write summary and report of the bag; return the exit code."""
    # Import late, because these imports take a second.
    from needle_bags.reading.bag_reader import read_run  # noqa: PLC0415
    from needle_bags.report.report import write_report  # noqa: PLC0415
    from needle_bags.run.run_summary import summarize  # noqa: PLC0415

    run = read_run(bag)
    summary = summarize(run)
    write_report(run, summary)
    summary["wall_s"] = time.time() - started_at
    for path in (bag / SUMMARY, options.json):
        write_json(path, summary)
    print(describe(summary, bag))
    return EXIT_DONE if summary["converged"] else EXIT_MISSED


def shown(path: Path) -> Path:
    """Return a path relative to the current folder if it is below it."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def describe(summary: Mapping[str, JsonValue], bag: Path) -> str:
    """Return the result as text.

    Parameters
    ----------
    summary : mapping
        Content of summary.json.
    bag : Path
        The run's folder.
    """

    def figure(key: str, digits: int = 2) -> str:
        value = summary.get(key)
        return f"{value:.{digits}f}" if isinstance(value, (int, float)) else "-"

    # Import late, because it takes a second.
    from needle_bags.report.pages import verdict_text  # noqa: PLC0415

    verdict, sentence = verdict_text(summary)
    in_plane = f"  r1, last 20 mm    {figure('r1_rms_last_20_mm')} mm rms"
    lines = [
        f"{verdict.upper()}: {sentence}",
        f"  steps             {summary.get('steps')}",
        *([in_plane] if summary.get("point_error_mm") is None else ()),
        f"  tip error         {figure('tip_error_p95_mm')} mm, of which in depth "
        f"{figure('depth_error_p95_mm')} mm (95th percentile)",
        f"  speed             {figure('steps_per_s', 1)} steps/s; {figure('wall_s', 1)} s in all",
        f"  report            {shown(bag / REPORT)}",
    ]
    if summary.get("watchdog_trips"):
        trips = summary["watchdog_trips"]
        lines.append(f"  watchdogs         tripped {trips} times: this run may not repeat exactly")
    return "\n".join(lines)


def _make_folder(options: SimulateOptions) -> Path:
    if options.bag is not None:
        folders = [options.bag]
    else:
        name = time.strftime(f"%Y-%m-%d_%H-%M-%S_{options.level}_{options.controller}")
        root = _checkout() / "bags"
        folders = [root / name, *(root / f"{name}_{number}" for number in range(2, 100))]
    for folder in folders:
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise UserError(f"cannot make the folder {folder}: {error.strerror}") from error
        return folder
    raise UserError(f"{folders[0]} exists already; give a new folder")


def _checkout() -> Path:
    """Return the checkout; for an installed package, the current folder."""
    with contextlib.suppress(UserError):
        return checkout()
    return Path.cwd()


def _end_with_parent() -> None:
    """Request SIGTERM for this process when scripts/simulate is killed."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)
    if os.getppid() == 1:
        os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
