"""`python -m campaign.mutants`: changes the code at random places, and counts detected changes."""

from __future__ import annotations

import dataclasses
import random
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from cosmic_ray.commands.init import _all_work_items
from cosmic_ray.mutating import mutate_and_test
from cosmic_ray.work_item import TestOutcome, WorkItem
from tqdm import tqdm

from needle_bringup.workplace import checkout
from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, run_command
from needle_core.commands.options import CommandParser

SOURCES = "ros2_ws/src"
REQUIRED = 0.9
"""Share of the mutants that the tests must detect."""
# Annotations are not evaluated: another operator between types has no effect.
OF_TYPES = "core/ReplaceBinaryOperator_BitOr"

DESCRIPTION = f"""\
Change the code at random places, one at a time, and list the changes that no test detects.

Mutates the driver's supervisor, axes and CiA 402 code and the controller's protocol, in a clone of
the last commit. A mutant counts as detected if a test fails or does not end. Exit code 1 below
{REQUIRED:.0%}. Requires cosmic-ray: python -m pip install cosmic-ray==8.7.0
"""


@dataclasses.dataclass(frozen=True)
class Target:
    """Folders whose code is changed.

    Attributes
    ----------
    package : str
        Name of the package.
    folders : tuple of str
        Folders of the package whose code is changed.
    tests : tuple of str
        Test files and folders that must detect the changes, relative to the package's `test`.
    """

    package: str
    folders: tuple[str, ...]
    tests: tuple[str, ...] = ("",)

    def modules(self, root: Path) -> list[Path]:
        """Return the modules that are changed, in a checkout."""
        package = root / SOURCES / self.package / self.package
        return sorted(path for name in self.folders for path in (package / name).glob("*.py"))

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
    parser.add_argument("--timeout", type=float, default=180.0, help="timeout of the tests [s]")

    def run() -> int:
        given = parser.parse_args()
        with tempfile.TemporaryDirectory(prefix="needle_mutants_") as folder:
            clone = Path(folder) / "clone"
            subprocess.run(["git", "clone", "-q", str(checkout()), str(clone)], check=True)
            chosen = random.Random(given.seed).sample(list(_mutants(clone)), given.sample)
            survivors = 0
            for target, item in tqdm(chosen, unit="mutant"):
                result = mutate_and_test(item.mutations, target.command(clone), given.timeout)
                if result.test_outcome is TestOutcome.SURVIVED:
                    survivors += 1
                    tqdm.write(result.diff)
        share = 1.0 - survivors / len(chosen)
        print(f"{len(chosen) - survivors} of {len(chosen)} mutants noticed ({share:.1%})")
        return EXIT_DONE if share >= REQUIRED else EXIT_MISSED

    return run_command(run)


def _mutants(root: Path) -> Iterator[tuple[Target, WorkItem]]:
    for target in TARGETS:
        for item in _all_work_items(target.modules(root), {}):
            if not item.mutations[0].operator_name.startswith(OF_TYPES):
                yield target, item


if __name__ == "__main__":
    sys.exit(main())
