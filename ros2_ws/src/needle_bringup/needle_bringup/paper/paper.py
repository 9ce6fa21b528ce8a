"""`scripts/paper`: every figure and number of [KC09] section IV."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from needle_bringup.workplace import checkout, make_folder
from needle_core.commands.cli import EXIT_DONE, run_command, write_json
from needle_core.commands.options import CommandParser, output_file, whole_number

PAGE = "paper.md"
IMAGES = "images"
OUT = "bags/paper"
DESCRIPTION = """\
Reproduce all figures and numbers of [KC09] section IV, and write them next to the paper's values:
paper.md, with its figures in images/. Trials run the complete rig, studies run monte_carlo.
"""
EPILOG = """\
examples:
  scripts/paper                    everything, into bags/paper/ (about ten minutes)
  scripts/paper --out docs         renew the page in docs/
  scripts/paper --quick --out /tmp/paper
      three trials instead of nine, 1,000 runs instead of 10,000

exit codes: 0 done; 2 invalid or missing input; 130 interrupted
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `paper`; return its exit code."""
    return run_command(lambda: _paper(sys.argv[1:] if arguments is None else arguments))


def _paper(arguments: Sequence[str]) -> int:
    parser = CommandParser("paper", DESCRIPTION, EPILOG)
    parser.add_argument("--quick", action="store_true", help="fewer trials and runs")
    parser.add_argument("--out", metavar="DIR", help=f"output folder (default: {OUT}/)")
    parser.add_argument(
        "--seed", default="1", metavar="N", help="seed of all random numbers (default: 1)"
    )
    parser.add_argument("--json", metavar="FILE", help="also write the figures as flat JSON")
    given = parser.parse_args(arguments)
    # The trials use consecutive seeds from this one on.
    seed = whole_number("--seed", given.seed, 0, 2**31 - 100)
    file = output_file("--json", given.json)
    out = make_folder("--out", given.out or str(checkout() / OUT))
    make_folder("--out", str(out / IMAGES))
    # Import late, because this takes a second and the command line may be invalid.
    from needle_bags.figures.figure_style import save  # noqa: PLC0415
    from needle_bringup.paper.paper_figures import figures_of  # noqa: PLC0415
    from needle_bringup.paper.paper_page import as_text, key_figures, page, table  # noqa: PLC0415
    from needle_bringup.paper.paper_results import Laboratory, PaperRuns  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as folder:
        results = PaperRuns(Laboratory(Path(folder)), seed, quick=given.quick)
    for name, figure in figures_of(results).items():
        save(figure, out / IMAGES / f"{name}.png")
    (out / PAGE).write_text(page(results), encoding="utf-8")
    print(as_text(list(table(results))))
    print(f"written: {out / PAGE}")
    write_json(file, key_figures(results))
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
