"""Descriptions of error codes: SDO aborts (CiA 301), drive errors (CiA 301, CiA 402)."""

from __future__ import annotations

TIMED_OUT = 0x0504_0000
NO_SUCH_OBJECT = (0x0602_0000, 0x0609_0011)
WRONG_LENGTH = (0x0607_0010, 0x0607_0012, 0x0607_0013)
HEARTBEAT_LOST = 0x8130

_ABORTS = {
    0x05030000: "SDO toggle bit error",
    TIMED_OUT: "Timeout of transfer communication detected",
    0x05040001: "Unknown SDO command specified",
    0x05040002: "Invalid block size",
    0x05040003: "Invalid sequence number",
    0x05040004: "CRC error",
    0x05040005: "Out of memory",
    0x06010000: "Unsupported access to an object",
    0x06010001: "Attempt to read a write only object",
    0x06010002: "Attempt to write a read only object",
    0x06020000: "Object does not exist",
    0x06040041: "Object cannot be mapped to the PDO",
    0x06040042: "PDO length exceeded",
    0x06040043: "General parameter incompatibility reason",
    0x06040047: "General internal incompatibility in the device",
    0x06060000: "Access failed due to a hardware error",
    0x06070010: "Data type and length code do not match",
    0x06070012: "Data type does not match, length of service parameter too high",
    0x06070013: "Data type does not match, length of service parameter too low",
    0x06090011: "Subindex does not exist",
    0x06090030: "Value range of parameter exceeded",
    0x06090031: "Value of parameter written too high",
    0x06090032: "Value of parameter written too low",
    0x06090036: "Maximum value is less than minimum value",
    0x060A0023: "Resource not available",
    0x08000000: "General error",
    0x08000020: "Data cannot be transferred or stored to the application",
    0x08000021: "Data cannot be transferred because of local control",
    0x08000022: "Data cannot be transferred because of the present device state",
    0x08000023: "No object dictionary is present",
    0x08000024: "No data available",
}

_ERRORS = {
    0x2310: "continuous over-current",
    0x2320: "short circuit",
    0x3110: "mains over-voltage",
    0x3120: "mains under-voltage",
    0x3130: "phase failure",
    0x3210: "DC link over-voltage",
    0x3220: "DC link under-voltage",
    0x4210: "drive too hot",
    0x4310: "drive too hot",
    0x5441: "external stop input",
    0x6010: "software watchdog of the drive",
    0x6320: "parameter error",
    0x7120: "motor error",
    0x7121: "motor blocked",
    0x7300: "sensor error",
    0x7305: "encoder error",
    0x8110: "CAN overrun",
    0x8120: "CAN error passive",
    HEARTBEAT_LOST: "the computer's heartbeat was missed",
    0x8140: "recovered from bus-off",
    0x8210: "PDO too short",
    0x8220: "PDO too long",
    0x8250: "RPDO time-out",
    0x8611: "following error",
    0x8612: "reference limit",
}
# Classes of other codes, by their upper four bits.
_ERROR_CLASSES = {
    0x1: "generic error",
    0x2: "current",
    0x3: "voltage",
    0x4: "temperature",
    0x5: "hardware",
    0x6: "software",
    0x7: "additional modules",
    0x8: "monitoring",
    0x9: "external error",
    0xF: "vendor-specific error",
}


def describe_abort(code: int) -> str:
    """Return the abort code of an SDO transfer with its description."""
    text = _ABORTS.get(code)
    return f"Code 0x{code:08X}" + (f", {text}" if text else "")


def describe_error(code: int) -> str:
    """Return a drive's error code (EMCY's first two bytes, or 0x603F) with its description."""
    text = _ERRORS.get(code) or _ERROR_CLASSES.get(code >> 12, "unknown error")
    return f"0x{code:04X} {text}"
