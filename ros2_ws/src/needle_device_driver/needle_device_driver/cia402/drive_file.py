"""Check of a drive's EDS or DCF file (CiA 306) for the objects that the set-up needs."""

from __future__ import annotations

import configparser
import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path

from needle_core.errors import UserError
from needle_device_driver.axes.axis import PERIOD
from needle_device_driver.axes.link import DriveError
from needle_device_driver.cia402.cia402 import SUPPORTS_CYCLIC_POSITION
from needle_device_driver.cia402.drive_monitor import DriveMonitor
from needle_device_driver.cia402.drive_settings import DriveSettings
from needle_device_driver.cia402.drive_setup import set_up, write_homing, write_limits
from needle_device_driver.cia402.drive_upkeep import arm_watchdog
from needle_device_driver.link import objects as od
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.object_access import DriveRefusalError, ObjectAccess, ObjectError
from needle_device_driver.link.sdo_client import SdoAbortedError, SdoClient
from needle_device_driver.procedure import Procedure, run_at_once

Address = tuple[int, int]
UNKNOWN = "unknown: read-only, and the file gives no value"
_MODE_OF_OPERATION, _MODE_DISPLAY, _STATUSWORD = (0x6060, 0), (0x6061, 0), (0x6041, 0)
# Values if the file gives none: a CiA 402 drive with a homing mode. Others are 0.
_ASSUMED = {(0x1000, 0): 402, (0x6502, 0): 1 << 5}
_SECTION = re.compile(r"([0-9a-f]{4})(?:sub([0-9a-f]{1,2}))?", re.IGNORECASE)
# Size in bytes of the data types, negative if signed; 0: not a number.
_SIZES = {1: 1, 2: -1, 3: -2, 4: -4, 5: 1, 6: 2, 7: 4, 0x15: -8, 0x1B: 8}
# First index of the mappings of up to 512 PDOs.
_PDO_MAPPINGS = (0x1600, 0x1A00)
_MISSING, _READ_ONLY, _NOT_MAPPABLE = 0x0602_0000, 0x0601_0002, 0x0604_0041
_WRONG_LENGTH, _RANGE = 0x0607_0010, 0x0609_0030


@dataclasses.dataclass(frozen=True)
class FileObject:
    """One object of a file.

    Attributes
    ----------
    size : int
        Size in bytes; negative: signed.
    writable, mappable : bool
        Whether a client may write it, and whether a PDO may contain it.
    value : int or None
        Its default, or in a DCF its configured value; None: the file gives none.
    lower, upper : int or None
        Its limits; None: those of its type.
    """

    size: int
    writable: bool
    mappable: bool
    value: int | None
    lower: int | None
    upper: int | None


def read_device_file(path: Path, node_id: int) -> tuple[str, dict[Address, FileObject]]:
    """Return the product's name and all objects of an EDS or DCF file.

    Raises
    ------
    UserError
        If the file cannot be read, or has neither format.
    """
    parser = configparser.RawConfigParser(
        strict=False, inline_comment_prefixes=(";",), allow_no_value=True
    )
    try:
        parser.read_string(path.read_text("latin-1"), str(path))
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    except configparser.Error as error:
        raise UserError(f"{path} is no EDS or DCF file: {' '.join(str(error).split())}") from error
    objects: dict[Address, FileObject] = {}
    for name in parser.sections():
        if match := _SECTION.fullmatch(name):
            section, index = parser[name], int(match[1], 16)
            count = _number(section.get("CompactSubObj"), node_id) or 0
            subindices = range(1, count + 1) if count else (int(match[2] or "0", 16),)
            # Records have no data type of their own.
            for subindex in subindices if section.get("DataType") else ():
                objects[index, subindex] = _file_object(section, node_id)
    if (0x1000, 0) not in objects:
        raise UserError(f"{path} is no EDS or DCF file: it has no section [1000]")
    product = parser.get("DeviceInfo", "ProductName", fallback="") or path.name
    return product.strip(), objects


def _file_object(section: Mapping[str, str | None], node_id: int) -> FileObject:
    size = _SIZES.get(_number(section.get("DataType"), node_id) or 0, 0)

    def value(key: str) -> int | None:
        number = _number(section.get(key), node_id)
        if number is not None and size < 0 and number >> (8 * -size - 1) == 1:
            # Hexadecimal two's complement.
            number -= 1 << 8 * -size
        return number

    writable = (section.get("AccessType") or "").strip().lower() in ("rw", "wo", "rwr", "rww")
    mappable = _number(section.get("PDOMapping"), node_id) == 1
    configured, default = value("ParameterValue"), value("DefaultValue")
    given = default if configured is None else configured
    return FileObject(size, writable, mappable, given, value("LowLimit"), value("HighLimit"))


def _number(text: str | None, node_id: int) -> int | None:
    """Return a number, or the sum of a number and the node id; None for any other text."""
    parts = (text or "").upper().replace("$NODEID", str(node_id)).split("+")
    try:
        return sum(int(part, 0) for part in parts)
    except ValueError:
        return None


class FileDevice(SdoClient):
    """Stand-in for a switched-off drive that has the objects of a file.

    Parameters
    ----------
    objects : mapping of Address to FileObject
        The objects.

    Attributes
    ----------
    problems : dict of Address to str
        Last refusal of each accessed object, in the order of access; empty: none.
    granted : set of Address
        Objects that accept everything.
    ignored : set of Address
        Objects that count as missing.
    """

    def __init__(self, objects: Mapping[Address, FileObject]) -> None:
        self.problems: dict[Address, str] = {}
        self.granted: set[Address] = set()
        self.ignored: set[Address] = set()
        self._objects = objects
        self._values: dict[Address, int] = {}

    def restart(self) -> None:
        """Restore the values of the file, and clear the record of accesses."""
        self.problems, self._values = {}, {_STATUSWORD: 0}

    def upload(self, index: int, subindex: int) -> Procedure[bytes]:
        """Return the value of an object."""
        yield from ()
        address = index, subindex
        found = self._object(address)
        value = self._values.get(address, found.value)
        value = _ASSUMED.get(address, 0) if value is None else value
        return value.to_bytes(9, "little", signed=True)[: abs(found.size)]

    def download(self, index: int, subindex: int, data: bytes) -> Procedure[None]:
        """Write an object if the file says that the drive accepts the value."""
        yield from ()
        address = index, subindex
        found = self._object(address)
        value = int.from_bytes(data, "little", signed=found.size < 0)
        if address not in self.granted:
            if not found.writable and found.value is not None:
                self._refuse(address, _READ_ONLY, f"fixed at {found.value}")
            if len(data) != abs(found.size):
                self._refuse(address, _WRONG_LENGTH, f"has {abs(found.size)} bytes")
            lower, upper = found.lower, found.upper
            if (lower is not None and value < lower) or (upper is not None and value > upper):
                self._refuse(address, _RANGE, f"{value} is outside [{lower}, {upper}]")
            if subindex and index & ~0x1FF in _PDO_MAPPINGS:
                mapped = self._objects.get((value >> 16, value >> 8 & 0xFF))
                if mapped is None or not mapped.mappable:
                    self._refuse(address, _NOT_MAPPABLE, f"0x{value >> 16:04X} cannot be mapped")
        self._values[address] = value
        if address == _MODE_OF_OPERATION:
            self._values[_MODE_DISPLAY] = value
        self.problems[address] = "" if found.writable else UNKNOWN

    def _object(self, address: Address) -> FileObject:
        if address in self.granted:
            return self._objects.get(address) or FileObject(4, True, True, 0, None, None)
        if address not in self._objects or address in self.ignored:
            self._refuse(address, _MISSING, "missing")
        self.problems.setdefault(address, "")
        return self._objects[address]

    def _refuse(self, address: Address, code: int, text: str) -> None:
        self.problems[address] = text
        raise SdoAbortedError(code)


class FileLink(FrameLink):
    """A bus with one drive that is described by a file.

    Parameters
    ----------
    device : FileDevice
        The drive.
    """

    def __init__(self, device: FileDevice) -> None:
        super().__init__("file")
        self._device = device
        self.open()

    def sdo_client(self, node_id: int) -> SdoClient:
        """Return the drive."""
        return self._device


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
        Reason why the drive refuses it; empty: accepted.
    is_fatal : bool
        Whether this makes the drive unusable.
    """

    rule: str
    name: str
    problem: str
    is_fatal: bool


def check_device_file(
    path: Path, settings: DriveSettings, watchdog: float
) -> tuple[str, list[ObjectRow], tuple[str, ...]]:
    """Run the driver's set-up against a file; repeat it as if the drive had granted each refusal.

    Parameters
    ----------
    path : Path
        The EDS or DCF file.
    settings : DriveSettings
        Settings of the drive.
    watchdog : float
        Watchdog time of the driver [s].

    Returns
    -------
    str
        The product's name.
    list of ObjectRow
        Objects that the set-up accesses.
    tuple of str
        Missing objects and assumptions that the driver will report.

    Raises
    ------
    UserError
        If the file has neither format, or its drive is not CiA 402.
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
