"""`python -m campaign.mutants`: changes the code at random places, and counts who notices."""

from __future__ import annotations

import dataclasses
import random
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue

import attrs
from cosmic_ray.commands.init import _all_work_items
from cosmic_ray.mutating import mutate_and_test
from cosmic_ray.work_item import TestOutcome, WorkItem
from tqdm import tqdm

from needle_bringup.workplace import checkout
from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, run_command
from needle_core.commands.options import CommandParser

SOURCES = "ros2_ws/src"
WANTED = 0.9
"""Share of the mutants that the tests must detect."""
# Annotations are not evaluated: another operator between types has no effect.
OF_TYPES = "core/ReplaceBinaryOperator_BitOr"

DESCRIPTION = f"""\
Change the code at random places, one at a time, and list the changes that no test detects.

Mutates the driver's supervisor, axes and CiA 402 code and the controller's protocol, in clones of
the last commit. A mutant counts as detected if a test fails or does not end. Exit code 1 below
{WANTED:.0%}. Requires cosmic-ray: python -m pip install cosmic-ray==8.7.0
"""


@dataclasses.dataclass(frozen=True)
class Target:
    """Folders whose code is changed.

    Attributes
    ----------
    package : str
        Name of the package.
    rooms : tuple of str
        Folders of the package whose code is changed.
    tests : tuple of str
        Test files and folders that must detect the changes, relative to the package's `test`.
    """

    package: str
    rooms: tuple[str, ...]
    tests: tuple[str, ...] = ("",)

    def modules(self, root: Path) -> list[Path]:
        """Return the modules that are changed, in a checkout."""
        folder = root / SOURCES / self.package / self.package
        return sorted(path for room in self.rooms for path in (folder / room).glob("*.py"))

    def command(self, root: Path) -> str:
        """Return the command line of the tests, in a checkout."""
        sources = root / SOURCES
        paths = [*(str(sources / package.name) for package in sources.iterdir()), "$PYTHONPATH"]
        tests = " ".join(str(sources / self.package / "test" / name) for name in self.tests)
        return (
            f"bash -c 'cd {root} && PYTHONPATH={':'.join(paths)} "
            f"{sys.executable} -m pytest -x -q -p no:randomly {tests}'"
        )


TARGETS = (
    Target("needle_device_driver", ("supervisor", "axes", "cia402")),
    Target("needle_controller", ("protocol",), ("protocol",)),
)


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = CommandParser("mutants", DESCRIPTION, "")
    parser.add_argument("--sample", type=int, default=400, help="number of mutants")
    parser.add_argument("--seed", type=int, default=1, help="seed of the sample")
    parser.add_argument("--cores", type=int, default=2, help="number of parallel runs")
    parser.add_argument("--timeout", type=float, default=180.0, help="timeout of the tests [s]")

    def run() -> int:
        given = parser.parse_args()
        with tempfile.TemporaryDirectory(prefix="needle_mutants_") as folder:
            clones = list(_clones(Path(folder), given.cores))
            chosen = random.Random(given.seed).sample(list(_mutants(clones[0])), given.sample)
            survivors = list(_survivors(chosen, clones, given.timeout))
        share = 1.0 - len(survivors) / len(chosen)
        for survivor in survivors:
            print(survivor)
        print(f"{len(chosen) - len(survivors)} of {len(chosen)} mutants noticed ({share:.1%})")
        return EXIT_DONE if share >= WANTED else EXIT_MISSED

    return run_command(run)


def _clones(folder: Path, count: int) -> Iterator[Path]:
    for number in range(count):
        clone = folder / str(number)
        subprocess.run(["git", "clone", "-q", str(checkout()), str(clone)], check=True)
        yield clone


def _mutants(root: Path) -> Iterator[tuple[Target, WorkItem]]:
    for target in TARGETS:
        for item in _all_work_items(target.modules(root), {}):
            if not item.mutations[0].operator_name.startswith(OF_TYPES):
                yield target, item


def _survivors(
    chosen: Sequence[tuple[Target, WorkItem]], clones: Sequence[Path], timeout: float
) -> Iterator[str]:
    """Yield the changes that no test detected."""
    free: SimpleQueue[Path] = SimpleQueue()
    for clone in clones:
        free.put(clone)

    def tried(mutant: tuple[Target, WorkItem]) -> str | None:
        target, item = mutant
        root = free.get()
        (mutation,) = item.mutations
        path = root / mutation.module_path.relative_to(clones[0])
        there = attrs.evolve(mutation, module_path=path)
        result = mutate_and_test([there], target.command(root), timeout)
        free.put(root)
        return result.diff if result.test_outcome is TestOutcome.SURVIVED else None

    with ThreadPoolExecutor(len(clones)) as pool:
        for diff in tqdm(pool.map(tried, chosen), total=len(chosen), unit="mutant"):
            if diff is not None:
                yield diff


if __name__ == "__main__":
    sys.exit(main())
