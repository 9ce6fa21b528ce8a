"""`ros2 run needle_device_driver check_drive`: what a drive supports, before it moves a needle."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, run_command
from needle_core.commands.options import CommandParser
from needle_device_driver.axes.cycle_times import PERIOD
from needle_device_driver.cia402.backend import drive_settings
from needle_device_driver.cia402.drive_file_check import ObjectRow, check_device_file
from needle_device_driver.link.device_file import UNKNOWN
from needle_device_driver.parameters import DeviceDriverParameters

_DESCRIPTION = """\
Check from its EDS or DCF file whether a CiA 402 drive has the objects that the safety rules need.

The set-up of device_driver runs against the file, with the default parameters of the insertion
axis. `optional`: the drive works without this object; docs/hardware.md states the effect.
"""
_EPILOG = """\
example:
  ros2 run needle_device_driver check_drive --eds DRIVE.eds

A drive may differ from its file: try it before you mount a needle.

exit codes: 0 usable; 1 not usable; 2 the file is no EDS or DCF of a CiA 402 drive; 130 interrupted
"""
# Any number: with it, a drive in rpm needs no 0x608F.
_COUNTS_PER_TURN = 20_000.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = CommandParser("check_drive", _DESCRIPTION, _EPILOG)
    parser.add_argument("--eds", type=Path, metavar="FILE", required=True, help="EDS or DCF file")
    return run_command(lambda: _check(parser.parse_args(arguments).eds))


def _check(path: Path) -> int:
    parameters = DeviceDriverParameters(insertion_counts_per_turn=_COUNTS_PER_TURN)
    settings = drive_settings(parameters, "insertion")
    product, rows, notes = check_device_file(
        path, settings, period=PERIOD, watchdog=parameters.watchdog
    )
    names = max(len(row.name) for row in rows)
    print(f"{product}\n")
    for row in rows:
        print(f"{row.rule:22}{row.name:{names + 2}}{_state(row)}")
    for note in notes:
        print(f"\nThe drive {note}.")
    count = sum(row.is_fatal for row in rows)
    print(f"\nNOT usable: {count} of {len(rows)} objects" if count else "\nusable")
    return EXIT_MISSED if count else EXIT_DONE


def _state(row: ObjectRow) -> str:
    if row.is_fatal:
        return f"NOT USABLE: {row.problem}"
    return f"optional: {row.problem}" if row.problem not in ("", UNKNOWN) else row.problem or "ok"


if __name__ == "__main__":
    sys.exit(main())
