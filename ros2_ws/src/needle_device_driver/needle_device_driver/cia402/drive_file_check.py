"""Checks from its EDS or DCF file whether a drive has what the driver's set-up needs."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from needle_core.errors import UserError
from needle_device_driver.axes.cycle_times import PERIOD
from needle_device_driver.axes.drive_errors import DriveError
from needle_device_driver.cia402.cia402 import SUPPORTS_CYCLIC_POSITION
from needle_device_driver.cia402.drive_monitor import DriveMonitor
from needle_device_driver.cia402.drive_settings import DriveSettings
from needle_device_driver.cia402.drive_setup import set_up, write_homing, write_limits
from needle_device_driver.cia402.drive_upkeep import arm_watchdog
from needle_device_driver.link import objects as od
from needle_device_driver.link.device_file import Address, FileDevice, FileLink, read_device_file
from needle_device_driver.link.object_access import DriveRefusalError, ObjectAccess, ObjectError
from needle_device_driver.procedure import Procedure, run_at_once

_PDOS = {
    index: pdo
    for pdo in (od.COMMAND, od.SET_POINT, od.STATUS, od.POSITION)
    for index in (pdo.communication, pdo.mapping)
}
_ENTRIES = {
    (entry.index, entry.subindex): entry
    for value in vars(od).values()
    for entry in (value if isinstance(value, tuple) else (value,))
    if isinstance(entry, od.Entry)
}


@dataclasses.dataclass(frozen=True)
class ObjectRow:
    """One object, or one PDO with its records.

    Attributes
    ----------
    rule, name : str
        The rule that needs it; its address and name.
    problem : str
        Why the drive refuses it; empty: it does not.
    is_fatal : bool
        Whether the drive is therefore not usable.
    """

    rule: str
    name: str
    problem: str
    is_fatal: bool


def check_device_file(
    path: Path, settings: DriveSettings, watchdog: float
) -> tuple[str, list[ObjectRow], tuple[str, ...]]:
    """Run the driver's set-up against a file; after a refusal, assume consent and run it again.

    Parameters
    ----------
    path : Path
        The EDS or DCF file.
    settings : DriveSettings
        Settings of the drive.
    watchdog : float
        Of the driver [s].

    Returns
    -------
    str
        The product's name.
    list of ObjectRow
        What the set-up accesses.
    tuple of str
        What the driver will report as missing or assumed.

    Raises
    ------
    UserError
        If the file is neither, or describes no CiA 402 drive.
    """
    product, objects = read_device_file(path, settings.node_id)
    device = FileDevice(objects)
    fatal: dict[Address, str] = {}
    while True:
        device.restart()
        try:
            notes = run_at_once(_whole_set_up(FileLink(device), settings, watchdog))
            return product, _rows(device.problems, fatal), () if fatal else notes
        except ObjectError as error:
            address = error.entry.index, error.entry.subindex
            if address in fatal:
                raise UserError(f"{path}: {error}") from error
            is_refusal = isinstance(error, DriveRefusalError)
            fatal[address] = device.problems[address] if is_refusal else str(error)
            (device.granted if is_refusal else device.ignored).add(address)
        except DriveError as error:
            raise UserError(f"{path}: {error}") from error


def _whole_set_up(
    link: FileLink, settings: DriveSettings, watchdog: float
) -> Procedure[tuple[str, ...]]:
    monitor = DriveMonitor(link, settings.node_id)
    access = ObjectAccess(link, settings.node_id)
    settings, notes = yield from set_up(link, monitor, settings, period=PERIOD, homed=False)
    yield from write_homing(access, settings, settings.speed)
    yield from write_limits(access, settings, homed=True)
    yield from arm_watchdog(link, settings, watchdog)
    modes = yield from access.read_optional(od.SUPPORTED_MODES)
    if modes is not None and not modes & SUPPORTS_CYCLIC_POSITION:
        notes += ("does not list its cyclic synchronous position mode (0x6502): ask its maker",)
    if settings.speed_unit != 1.0:
        notes += ("has speeds in rpm: set *_counts_per_turn if it does not report 0x608F",)
    return notes


def _rows(problems: Mapping[Address, str], fatal: Mapping[Address, str]) -> list[ObjectRow]:
    rows: dict[str, ObjectRow] = {}
    for address, problem in {**problems, **fatal}.items():
        pdo = _PDOS.get(address[0])
        entry = pdo.entries[0] if pdo else _ENTRIES.get(address)
        if entry and (entry.rule or address in fatal):
            name = f"0x{pdo.communication:04X} PDO of {entry}" if pdo else str(entry)
            before = rows.get(name)
            is_fatal = address in fatal or bool(before and before.is_fatal)
            where = f"0x{address[0]:04X}:{address[1]} " if pdo and problem else ""
            text = where + problem or (before.problem if before else "")
            rows[name] = ObjectRow(entry.rule.value if entry.rule else "", name, text, is_fatal)
    return sorted(rows.values(), key=lambda row: row.rule)
