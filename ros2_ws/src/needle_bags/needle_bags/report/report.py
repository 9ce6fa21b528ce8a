"""`report`: the report of a run from its bag, or the comparison of two runs, as a web page."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from needle_bags.figures.event_figure import event_figure
from needle_bags.figures.figure_style import save
from needle_bags.figures.film import camera_views, film_of, plan_views
from needle_bags.figures.run_figures import run_figures
from needle_bags.figures.timing_figure import timing_figure
from needle_bags.reading.bag_reader import Run, read_run
from needle_bags.report.pages import build_page, build_pair_page, pair_values, verdict_text
from needle_bags.run.run_summary import summarize
from needle_bags.run.stage_timing import stage_timings
from needle_core.commands.cli import EXIT_DONE, JsonValue, run_command, write_json
from needle_core.commands.options import CommandParser
from needle_core.errors import UserError
from needle_core.files.file_access import replace_file

PAGE = "report.html"

_DESCRIPTION = """
Report on a recorded run: whether the tip reached the target plane, its error on the way, the camera
images, the duration of each stage, and the faults.

Writes report.html and its figures as PNG files into the bag's directory (or --output). report.html
is one file of at most 6 MB with a film of the insertion and all figures; it needs no network and
can be printed. With two bags, writes a page that compares them, compared_with_<A>.html, into the
directory of the second bag (or --output).

A single .mcap file is read without the other files of its directory; its report is written into
<file>_report next to it.
"""
_EXAMPLES = """
examples:
  ros2 run needle_bags report bags/2026-03-01_10-20-30_camera_paper
  ros2 run needle_bags report BAG --json figures.json --output /tmp/report
  ros2 run needle_bags report bags/paper_run bags/best_run
  ros2 run needle_bags report downloads/monday.mcap

exit codes: 0 done; 2 a bag is missing, damaged, incomplete, or not of a needle run
"""


def write_report(run: Run, summary: dict[str, JsonValue], directory: Path | None = None) -> Path:
    """Write a run's report and its figures.

    Parameters
    ----------
    run : Run
        The recorded run (`bag_reader.read_run`).
    summary : dict
        Its figures (`run_summary.summarize`).
    directory : Path, optional
        Destination; by default the bag's directory, or `<file>_report` next to a single file.

    Returns
    -------
    Path
        Path of the report.html.

    Raises
    ------
    UserError
        If a file cannot be written or the bag's images cannot be read.
    """
    timings = stage_timings(run)
    frames = film_of(run)
    views = [*camera_views(run, frames), *plan_views(run, frames)]
    figures = run_figures([run])
    if timings:
        figures["timing"] = timing_figure(run, timings)
    if (events := event_figure(run)) is not None:
        figures["events"] = events
    data = {name: _png(figure) for name, figure in figures.items()}
    files = {f"{name}.png": png for name, png in data.items()}
    files[PAGE] = build_page(run, summary, data, timings, (frames, views)).encode()
    return _write(directory or _folder(run), files)


def write_pair_report(
    runs: tuple[Run, Run],
    summaries: tuple[dict[str, JsonValue], dict[str, JsonValue]],
    directory: Path | None = None,
) -> Path:
    """Write the page that compares two runs.

    Parameters
    ----------
    runs, summaries : pairs
        Both runs and their figures.
    directory : Path, optional
        Destination; by default the directory of the second bag.

    Returns
    -------
    Path
        Path of the page.

    Raises
    ------
    UserError
        If it cannot be written.
    """
    data = {name: _png(figure) for name, figure in run_figures(runs).items()}
    name = f"compared_with_{runs[0].path.absolute().name}.html"
    page = build_pair_page(runs, summaries, data).encode()
    return _write(directory or _folder(runs[1]), {name: page})


def _folder(run: Run) -> Path:
    """Return the default destination of a report."""
    stem = run.path.name.removesuffix(".zstd").removesuffix(".mcap")
    return run.path.with_name(f"{stem}_report") if run.path.is_file() else run.path


def _write(directory: Path, files: Mapping[str, bytes]) -> Path:
    """Write files into a folder; return the path of the last."""
    path = directory
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            path = directory / name
            replace_file(path, data)
    except OSError as error:
        raise UserError(f"cannot write the report into {directory}: {error.strerror}") from error
    return path


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    save(figure, buffer)
    return buffer.getvalue()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    parser = CommandParser("report", _DESCRIPTION, _EXAMPLES)
    parser.add_argument("bag", type=Path, metavar="BAG", help="directory of the bag, or a file")
    parser.add_argument(
        "other", type=Path, nargs="?", metavar="OTHER_BAG", help="compare BAG with this bag"
    )
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="also write the figures of the run as flat JSON"
    )
    parser.add_argument(
        "--namespace", metavar="NS", help="namespace of the rig, if the bag has several"
    )
    parser.add_argument("--output", type=Path, metavar="DIR", help="write into this directory")
    return run_command(lambda: _report(parser.parse_args(arguments)))


def _report(given: argparse.Namespace) -> int:
    first = read_run(given.bag, given.namespace)
    summary = summarize(first)
    if given.other is None:
        page = write_report(first, summary, given.output)
        words, sentence = verdict_text(summary)
        print(f"{words}: {sentence}\n{page}")
    else:
        second = read_run(given.other, given.namespace)
        summaries = (summary, summarize(second))
        page = write_pair_report((first, second), summaries, given.output)
        for letter, figures in zip("AB", summaries, strict=True):
            words, sentence = verdict_text(figures)
            print(f"{letter} {words}: {sentence}")
        print(page)
        summary = pair_values(summaries)
    write_json(given.json, summary)
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
