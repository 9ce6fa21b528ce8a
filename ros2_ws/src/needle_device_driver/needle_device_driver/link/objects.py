"""Entries and PDOs of a CiA 402 drive's object dictionary that the driver uses."""

from __future__ import annotations

import dataclasses
import struct

from needle_core.errors import OutOfBoundsError
from needle_device_driver.rules import Rule


@dataclasses.dataclass(frozen=True)
class Entry:
    """One entry of an object dictionary.

    Attributes
    ----------
    index, subindex : int
        Address.
    format : str
        `struct` format, little-endian.
    name : str
        Name in CiA 301 or CiA 402.
    rule : Rule or None
        The safety rule that needs it.
    """

    index: int
    subindex: int
    format: str
    name: str
    rule: Rule | None = None

    def __str__(self) -> str:
        """Return address and name, for messages."""
        return f"0x{self.index:04X}:{self.subindex} {self.name}"

    @property
    def size(self) -> int:
        """Size in bytes."""
        return struct.calcsize(self.format)

    @property
    def mapping(self) -> int:
        """Value of the entry in a PDO mapping."""
        return self.index << 16 | self.subindex << 8 | 8 * self.size

    def pack(self, value: int) -> bytes:
        """Encode a value.

        Raises
        ------
        OutOfBoundsError
            If the value does not fit.
        """
        try:
            return struct.pack(self.format, value)
        except struct.error:
            bits = 8 * self.size
            signed = self.format[-1].islower()
            lower = -(2 ** (bits - 1)) if signed else 0
            upper = 2 ** (bits - signed) - 1
            raise OutOfBoundsError(str(self), value, lower, upper, "counts") from None

    def unpack(self, data: bytes) -> int:
        """Decode a value; extra bytes, which some drives send, are ignored.

        Raises
        ------
        ValueError
            If bytes are missing.
        """
        if len(data) < self.size:
            raise ValueError(f"{self}: {len(data)} bytes, expected {self.size}")
        value: int = struct.unpack(self.format, data[: self.size])[0]
        return value

    def resized(self, size: int) -> Entry | None:
        """Return the same entry with a size of 1, 2 or 4 bytes; None for other sizes."""
        wider = {1: "<b", 2: "<h", 4: "<i"}.get(size)
        if wider is None:
            return None
        signed = self.format[-1].islower()
        return dataclasses.replace(self, format=wider if signed else wider.upper())


U8, U16, U32, I8, I16, I32 = "<B", "<H", "<I", "<b", "<h", "<i"

DEVICE_TYPE = Entry(0x1000, 0, U32, "device type")
CYCLE_PERIOD = Entry(0x1006, 0, U32, "communication cycle period [us]", Rule.LOOK_AHEAD)
CONSUMER_HEARTBEAT = Entry(0x1016, 1, U32, "consumer heartbeat time", Rule.DRIVE_WATCHDOG)
PRODUCER_HEARTBEAT = Entry(0x1017, 0, U16, "producer heartbeat time [ms]", Rule.DRIVE_REBOOT)
ERROR_BEHAVIOUR = Entry(0x1029, 1, U8, "communication error behaviour", Rule.DRIVE_REBOOT)
ABORT_CONNECTION_OPTION = Entry(0x6007, 0, I16, "abort connection option", Rule.DRIVE_WATCHDOG)
ERROR_CODE = Entry(0x603F, 0, U16, "error code")
CONTROLWORD = Entry(0x6040, 0, U16, "controlword", Rule.ONE_FAULT_STOPS_BOTH)
STATUSWORD = Entry(0x6041, 0, U16, "statusword", Rule.ONE_FAULT_STOPS_BOTH)
QUICK_STOP_OPTION = Entry(0x605A, 0, I16, "quick stop option", Rule.QUICK_STOP)
SHUTDOWN_OPTION = Entry(0x605B, 0, I16, "shutdown option", Rule.QUICK_STOP)
DISABLE_OPTION = Entry(0x605C, 0, I16, "disable operation option", Rule.QUICK_STOP)
FAULT_REACTION_OPTION = Entry(0x605E, 0, I16, "fault reaction option", Rule.DRIVE_WATCHDOG)
MODE_OF_OPERATION = Entry(0x6060, 0, I8, "mode of operation", Rule.LOOK_AHEAD)
MODE_DISPLAY = Entry(0x6061, 0, I8, "mode of operation display", Rule.LOOK_AHEAD)
POSITION_ACTUAL = Entry(0x6064, 0, I32, "position actual value", Rule.FOLLOWING_ERROR)
FOLLOWING_WINDOW = Entry(0x6065, 0, U32, "following error window", Rule.FOLLOWING_ERROR)
FOLLOWING_TIMEOUT = Entry(0x6066, 0, U16, "following error time-out [ms]", Rule.FOLLOWING_ERROR)
MAX_TORQUE = Entry(0x6072, 0, U16, "max torque [1/1000 of rated]", Rule.FOLLOWING_ERROR)
TARGET_POSITION = Entry(0x607A, 0, I32, "target position", Rule.LOOK_AHEAD)
HOME_OFFSET = Entry(0x607C, 0, I32, "home offset", Rule.SOFTWARE_LIMITS)
LOWER_LIMIT = Entry(0x607D, 1, I32, "software position limit, lower", Rule.SOFTWARE_LIMITS)
UPPER_LIMIT = Entry(0x607D, 2, I32, "software position limit, upper", Rule.SOFTWARE_LIMITS)
MAX_PROFILE_VELOCITY = Entry(0x607F, 0, U32, "max profile velocity", Rule.AXIS_SPEED)
PROFILE_VELOCITY = Entry(0x6081, 0, U32, "profile velocity", Rule.AXIS_SPEED)
PROFILE_ACCELERATION = Entry(0x6083, 0, U32, "profile acceleration", Rule.AXIS_SPEED)
PROFILE_DECELERATION = Entry(0x6084, 0, U32, "profile deceleration", Rule.QUICK_STOP)
QUICK_STOP_DECELERATION = Entry(0x6085, 0, U32, "quick stop deceleration", Rule.QUICK_STOP)
ENCODER_RESOLUTION = Entry(0x608F, 1, U32, "increments"), Entry(0x608F, 2, U32, "motor turns")
GEAR_RATIO = Entry(0x6091, 1, U32, "motor turns"), Entry(0x6091, 2, U32, "shaft turns")
FEED_CONSTANT = Entry(0x6092, 1, U32, "feed"), Entry(0x6092, 2, U32, "shaft turns")
SPEED_FACTOR = Entry(0x6096, 1, U32, "velocity factor"), Entry(0x6096, 2, U32, "divisor")
HOMING_METHOD = Entry(0x6098, 0, I8, "homing method", Rule.HOMING_TIME)
HOMING_SPEED_SWITCH = Entry(0x6099, 1, U32, "homing speed towards the switch", Rule.HOMING_TIME)
HOMING_SPEED_ZERO = Entry(0x6099, 2, U32, "homing speed towards zero", Rule.HOMING_TIME)
HOMING_ACCELERATION = Entry(0x609A, 0, U32, "homing acceleration", Rule.HOMING_TIME)
POSITION_UNIT = Entry(0x60A8, 0, U32, "SI unit position", Rule.AXIS_SPEED)
SPEED_UNIT = Entry(0x60A9, 0, U32, "SI unit velocity", Rule.AXIS_SPEED)
RAMP_UNIT = Entry(0x60AA, 0, U32, "SI unit acceleration", Rule.AXIS_SPEED)
INTERPOLATION_PERIOD = Entry(0x60C2, 1, U8, "interpolation period", Rule.LOOK_AHEAD)
INTERPOLATION_EXPONENT = Entry(0x60C2, 2, I8, "interpolation period's exponent", Rule.LOOK_AHEAD)
FOLLOWING_ERROR = Entry(0x60F4, 0, I32, "following error actual value", Rule.FOLLOWING_ERROR)
DIGITAL_INPUTS = Entry(0x60FD, 0, U32, "digital inputs", Rule.INNER_LIMIT_SWITCH)
SUPPORTED_MODES = Entry(0x6502, 0, U32, "supported drive modes", Rule.LOOK_AHEAD)

CIA402 = 402
# Bits of the digital inputs.
NEGATIVE_LIMIT_SWITCH = 1 << 0
POSITIVE_LIMIT_SWITCH = 1 << 1
HOME_SWITCH = 1 << 2

# Values that switch the software limits off; some drives accept only part of the range.
NO_LIMITS = ((-(2**31), 2**31 - 1), (-(2**31) + 1, 2**31 - 1), (-(2**30), 2**30 - 1))

# Function codes of the predefined connection set; a COB-ID is function code plus node id.
NMT = 0x000
SYNC = 0x080
EMCY = 0x080
TPDO1, TPDO2 = 0x180, 0x280
RPDO1, RPDO2 = 0x200, 0x300
SDO_RESPONSE, SDO_REQUEST = 0x580, 0x600
HEARTBEAT = 0x700

# The computer's own node id; the drives' watchdogs monitor its heartbeat.
MASTER_NODE_ID = 127

NMT_START, NMT_PRE_OPERATIONAL = 0x01, 0x80
NMT_BOOT_UP, NMT_OPERATIONAL = 0x00, 0x05

# Transmission types: immediate (as the device profile or the manufacturer defines it); at SYNC.
ASYNCHRONOUS, ASYNCHRONOUS_BY_MANUFACTURER, SYNCHRONOUS = 255, 254, 1
# Bits of a PDO's COB-ID: the PDO is off; remote frames are not supported.
PDO_OFF, PDO_NO_REMOTE = 1 << 31, 1 << 30


@dataclasses.dataclass(frozen=True)
class Pdo:
    """A process data object.

    Attributes
    ----------
    communication, mapping : int
        Indices of its communication and mapping records.
    function_code : int
        COB-ID without the node id.
    transmission : int
        Transmission type.
    entries : tuple of Entry
        Mapped entries.
    """

    communication: int
    mapping: int
    function_code: int
    transmission: int
    entries: tuple[Entry, ...]

    def pack(self, *values: int) -> bytes:
        """Encode the values."""
        return b"".join(e.pack(v) for e, v in zip(self.entries, values, strict=True))

    def unpack(self, data: bytes) -> tuple[int, ...]:
        """Decode the values; a drive may lack the last entry.

        Raises
        ------
        ValueError
            If the length is wrong.
        """
        for entries in (self.entries, self.entries[:-1]):
            formats = "<" + "".join(entry.format[-1] for entry in entries)
            if len(data) == struct.calcsize(formats):
                return struct.unpack(formats, data)
        raise ValueError(f"PDO of {len(data)} bytes, not of {self.entries}")


# A command takes effect on arrival, so that a stop does not wait; set-points at the SYNC.
COMMAND = Pdo(0x1400, 0x1600, RPDO1, ASYNCHRONOUS, (CONTROLWORD, MODE_OF_OPERATION))
SET_POINT = Pdo(0x1401, 0x1601, RPDO2, SYNCHRONOUS, (TARGET_POSITION,))
STATUS = Pdo(0x1800, 0x1A00, TPDO1, SYNCHRONOUS, (STATUSWORD, MODE_DISPLAY, DIGITAL_INPUTS))
STATUS_WITHOUT_INPUTS = Pdo(0x1800, 0x1A00, TPDO1, SYNCHRONOUS, (STATUSWORD, MODE_DISPLAY))
POSITION = Pdo(0x1801, 0x1A01, TPDO2, SYNCHRONOUS, (POSITION_ACTUAL, FOLLOWING_ERROR))
POSITION_ALONE = Pdo(0x1801, 0x1A01, TPDO2, SYNCHRONOUS, (POSITION_ACTUAL,))
