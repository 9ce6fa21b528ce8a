"""`report`: makes report.html, its figures and summary.json from a bag alone."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence
from pathlib import Path

from needle_bringup.bag_reader import Run, read_run
from needle_bringup.figures import figures_of, save
from needle_bringup.image_figure import images_figure
from needle_bringup.report_page import build_page, verdict_text
from needle_bringup.run_summary import summarize
from needle_common.cli import EXIT_DONE, JsonValue, run_command, write_json
from needle_common.errors import UserError

PAGE = "report.html"

_DESCRIPTION = """
Shows how a recorded run went: did the tip reach the wanted plane, how far off was it on the way,
what did the cameras see. Everything comes from the bag.

Writes into the bag's directory (or --output): report.html, one file with all figures in it that
opens in any browser and prints; and the figures as PNG files.
"""
_EXAMPLES = """
examples:
  ros2 run needle_bringup report bags/2026-03-01_10-20-30_camera_paper
  ros2 run needle_bringup report BAG --json figures.json --output /tmp/report

exit codes: 0 done; 2 the bag is missing, broken, unfinished, or not of a needle run
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
        Where to; the bag's directory by default.

    Returns
    -------
    Path
        The report.html written.

    Raises
    ------
    UserError
        If a file cannot be written or the bag's images cannot be read.
    """
    target = run.path if directory is None else directory
    figures = figures_of(run)
    images = images_figure(run)
    if images is not None:
        figures["images"] = images
    try:
        target.mkdir(parents=True, exist_ok=True)
        data: dict[str, bytes] = {}
        for name, figure in figures.items():
            buffer = io.BytesIO()
            save(figure, buffer)
            data[name] = buffer.getvalue()
            (target / f"{name}.png").write_bytes(data[name])
        page = target / PAGE
        page.write_text(build_page(run, summary, data), encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write the report into {target}: {error.strerror}") from error
    return page


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="report",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("bag", type=Path, metavar="BAG", help="the bag's directory")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="also write the figures of the run as flat JSON"
    )
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help="write here and not into the bag's directory"
    )
    options = parser.parse_args(arguments)

    def command() -> int:
        run = read_run(options.bag)
        summary = summarize(run)
        page = write_report(run, summary, options.output)
        if options.json is not None:
            write_json(options.json, summary)
        words, sentence = verdict_text(summary)
        print(f"{words}: {sentence}\n{page}")
        return EXIT_DONE

    return run_command(command)


if __name__ == "__main__":
    sys.exit(main())
