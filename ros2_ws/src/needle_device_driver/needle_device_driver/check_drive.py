"""`ros2 run needle_device_driver check_drive`: report what a drive supports."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, run_command
from needle_core.commands.options import CommandParser
from needle_core.errors import UserError
from needle_core.runners.paced import PacedRunner
from needle_device_driver.axes.axis import PERIOD
from needle_device_driver.cia402.backend import drive_settings
from needle_device_driver.cia402.drive_file import UNKNOWN, ObjectRow, check_device_file
from needle_device_driver.conformance.scenarios import RULES, verdict
from needle_device_driver.device_driver import DeviceDriver
from needle_device_driver.parameters import DeviceDriverParameters, read_driver_parameters

_DESCRIPTION = """\
Check what a drive supports of the safety rules, without moving it.

--params FILE connects to the drives as device_driver would with this parameter file, sets them up
without switching them on, and prints what they can do and how they keep each rule. Stop
device_driver first.

--eds FILE needs no drive: the set-up of device_driver runs against the EDS or DCF file of a CiA 402
drive, with the default parameters of the insertion axis. `optional`: the drive works without this
object; docs/hardware.md states the effect. A drive may differ from its file.
"""
_EPILOG = """\
examples:
  ros2 run needle_device_driver check_drive --params drives.yaml
  ros2 run needle_device_driver check_drive --eds DRIVE.eds

exit codes: 0 usable; 1 not usable; 2 invalid file, no drive, or it refuses its set-up; 130
interrupted
"""
# An arbitrary value, so that a drive in rpm needs no 0x608F.
_COUNTS_PER_TURN = 20_000.0
# Time for device_driver to shut down [s].
_END = 2.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = CommandParser("check_drive", _DESCRIPTION, _EPILOG)
    group = parser.add_mutually_exclusive_group(required=True)
    group.add_argument("--params", type=Path, metavar="FILE", help="parameters of device_driver")
    group.add_argument("--eds", type=Path, metavar="FILE", help="EDS or DCF file")

    def check() -> int:
        given = parser.parse_args(arguments)
        return _check_file(given.eds) if given.eds else _check_drives(given.params)

    return run_command(check)


def _check_drives(path: Path) -> int:
    settings = read_driver_parameters(path)
    driver = DeviceDriver(settings)
    runner = PacedRunner([driver], ports=settings.ports())
    try:
        while not driver.is_set_up:
            if runner.run(PERIOD):
                raise UserError(runner.exits[driver.name].text)
        for drives in driver.drives:
            print(f"{drives.link.name}: {' and '.join(drives.axes)}\n")
            for name, value in vars(drives.capabilities).items():
                text = ("no", "yes")[value] if isinstance(value, bool) else f"{value:g} s"
                print(f"{name:22}{text}")
            print()
            for rule in RULES:
                print(f"{rule.value:22}{verdict(rule, drives.capabilities, settings)}")
            for text in drives.missing_optional_parts:
                print(f"\nThe {text}.")
            print()
        runner.stop(driver.name)
        runner.run(_END)
    finally:
        runner.close()
    return EXIT_DONE


def _check_file(path: Path) -> int:
    parameters = DeviceDriverParameters(insertion_counts_per_turn=_COUNTS_PER_TURN)
    settings = drive_settings(parameters, "insertion")
    product, rows, notes = check_device_file(path, settings, parameters.watchdog)
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
