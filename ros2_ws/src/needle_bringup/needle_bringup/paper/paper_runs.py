"""Runs the trials and studies for the paper's results."""

from __future__ import annotations

import contextlib
import csv
import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from needle_bags.reading.bag_reader import Run, read_run
from needle_bringup.workplace import ran
from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, JsonValue
from needle_core.files.installed import find_executable

Columns = Mapping[str, npt.NDArray[np.float64]]
SUMMARY = "summary.json"


class Laboratory:
    """Runs trials and studies, each once.

    Parameters
    ----------
    simulate : sequence of str
        Command of a trial.
    folder : Path
        Folder for the results; existing ones are reused.
    """

    def __init__(self, simulate: Sequence[str], folder: Path) -> None:
        self._simulate = list(simulate)
        self._folder = folder

    def trial(self, name: str, *arguments: str) -> Run:
        """Run a trial and read its bag; a missed plane is no error.

        Raises
        ------
        UserError
            If it fails.
        """
        bag = self._folder / name
        if not (bag / SUMMARY).is_file():
            shutil.rmtree(bag, ignore_errors=True)  # of an earlier, failed run
            command = [*self._simulate, *arguments, "--bag", str(bag)]
            _run(name, command, (EXIT_DONE, EXIT_MISSED))
        return read_run(bag)

    def study(self, name: str, *arguments: str) -> tuple[dict[str, JsonValue], Columns]:
        """Run a Monte Carlo study; return its figures, and the numeric columns of its runs.

        Raises
        ------
        UserError
            If it fails.
        """
        figures, runs = self._folder / f"{name}.json", self._folder / f"{name}.csv"
        if not figures.is_file():
            command = [find_executable("needle_sim", "monte_carlo"), *arguments]
            _run(name, [*command, "--csv", str(runs), "--json", str(figures)], (EXIT_DONE,))
        with runs.open(encoding="utf-8", newline="") as stream:
            reader = csv.reader(stream)
            head = next(reader)
            columns = dict(zip(head, zip(*reader, strict=True), strict=True))
        return dict(json.loads(figures.read_text("utf-8"))), _numbers(columns)

    def identify(self, name: str, bag: str, *arguments: str) -> dict[str, JsonValue]:
        """Identify the curvature in the bag of a trial; return the figures.

        Raises
        ------
        UserError
            If it fails.
        """
        figures = self._folder / f"{name}.json"
        if not figures.is_file():
            command = [find_executable("needle_controller", "identify_curvature")]
            command += [str(self._folder / bag), *arguments, "--json", str(figures)]
            _run(name, command, (EXIT_DONE,))
        return dict(json.loads(figures.read_text("utf-8")))


def _numbers(columns: Mapping[str, Sequence[str]]) -> Columns:
    """Return the numeric columns, with NaN for empty cells."""
    numbers = {}
    for name, cells in columns.items():
        with contextlib.suppress(ValueError):
            numbers[name] = np.array([float(cell) if cell else np.nan for cell in cells])
    return numbers


def _run(name: str, command: Sequence[str], good: Sequence[int]) -> None:
    print(f"running {name} ...", file=sys.stderr, flush=True)
    if ran(command, (*good, 130, -2), what=name).returncode in (130, -2):
        raise KeyboardInterrupt
