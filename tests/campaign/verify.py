"""`scripts/verify`: full-size checks of each step, with required and measured figures."""

from __future__ import annotations

import contextlib
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from campaign.checking import Check, Finding, Workbench
from campaign.checks import (
    check_bags,
    check_continuous,
    check_control,
    check_driver,
    check_holds,
    check_simulation,
    check_traced,
    check_tracker,
)
from child_processes import ending_descendants
from needle_bringup.workplace import checkout, make_folder
from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, JsonValue, run_command, write_json
from needle_core.commands.options import CommandParser
from needle_core.errors import UserError

STEPS: Mapping[str, tuple[Check, ...]] = {
    "A": check_simulation.CHECKS,
    "B": check_control.CHECKS,
    "C": (*check_tracker.CHECKS, *check_traced.CHECKS),
    "D": check_driver.CHECKS,
    "E": check_bags.CHECKS,
    "I": (*check_continuous.CHECKS, *check_holds.HOLD_CHECKS),
    "K": check_holds.COMPUTER_CHECKS,
}

DESCRIPTION = """\
Run the full-size checks of each step of the project; print expected and measured values.
"""
EPILOG = """\
examples:
  scripts/verify A                 all checks of step A
  scripts/verify A --only camera --only same_seed
  scripts/verify --list            names of all checks

exit codes: 0 all checks passed; 1 a check failed; 2 invalid input; 130 interrupted
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `verify`; returns its exit code."""
    return run_command(lambda: _verify(sys.argv[1:] if arguments is None else arguments))


def _verify(arguments: Sequence[str]) -> int:
    parser = CommandParser("verify", DESCRIPTION, EPILOG)
    parser.add_argument(
        "steps", nargs="*", metavar="STEP", help=f"{', '.join(STEPS)} (default: all)"
    )
    parser.add_argument("--only", action="append", metavar="NAME", help="only this check")
    parser.add_argument("--list", action="store_true", help="list the checks and exit")
    parser.add_argument("--keep", metavar="DIR", help="keep the bags in this new folder")
    parser.add_argument("--json", metavar="FILE", help="also write the results as flat JSON")
    given = parser.parse_args(arguments)
    checks = _chosen(given.steps or list(STEPS), given.only)
    if given.list:
        for step, check in checks:
            print(f"{step} {check.__name__:24} {(check.__doc__ or '').splitlines()[0]}")
        return EXIT_DONE
    begin = time.monotonic()
    findings: list[tuple[str, Finding]] = []
    keep = given.keep and make_folder("--keep", given.keep, exist_ok=False)
    with (
        contextlib.nullcontext(keep) if keep else tempfile.TemporaryDirectory() as folder,
        ending_descendants(),
    ):
        bench = Workbench([str(checkout() / "scripts" / "simulate")], Path(folder))
        for step, check in checks:
            for finding in _findings(check, bench):
                findings.append((step, finding))
                _show(step, finding)
    failed = sum(not finding.passed for _, finding in findings)
    print(f"{len(findings) - failed} of {len(findings)} as required")
    if given.json:
        write_json(Path(given.json), _flat(findings, time.monotonic() - begin))
    return EXIT_MISSED if failed else EXIT_DONE


def _findings(check: Check, bench: Workbench) -> Iterator[Finding]:
    """Run a check; a check that fails to run is a missed finding."""
    try:
        yield from check(bench)
    except (UserError, ModuleNotFoundError) as error:
        what = (check.__doc__ or "").splitlines()[0]
        yield Finding(check.__name__, what, "can be checked", str(error), False)


def _chosen(steps: Sequence[str], only: Sequence[str] | None) -> list[tuple[str, Check]]:
    for step in steps:
        if step not in STEPS:
            raise UserError(f"step {step!r} does not exist; known: {', '.join(STEPS)}")
    checks = [(step, check) for step in steps for check in STEPS[step]]
    names = [check.__name__ for _, check in checks]
    for name in only or ():
        if name not in names:
            raise UserError(f"--only {name!r} is not one of {', '.join(names)}")
    return [(step, check) for step, check in checks if not only or check.__name__ in only]


def _show(step: str, finding: Finding) -> None:
    mark = "ok  " if finding.passed else "MISS"
    print(f"{mark} {step} {finding.what}")
    print(f"         required {finding.required}\n         measured {finding.measured}", flush=True)


def _flat(findings: Sequence[tuple[str, Finding]], wall: float) -> dict[str, JsonValue]:
    values: dict[str, JsonValue] = {
        "passed": all(finding.passed for _, finding in findings),
        "wall_s": wall,
    }
    for step, finding in findings:
        values[f"{step}_{finding.key}"] = finding.passed
        values[f"{step}_{finding.key}_wanted"] = finding.required
        values[f"{step}_{finding.key}_seen"] = finding.measured
    return values


if __name__ == "__main__":
    sys.exit(main())
