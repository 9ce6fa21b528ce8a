"""Meaning of a drive's emergency message (EMCY, CiA 301 and CiA 402), in words."""

from __future__ import annotations

HEARTBEAT_LOST = 0x8130

# Exact codes first; else the class, the upper digits.
_CODES = {
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
_CLASSES = {
    0x1: "generic error",
    0x2: "current",
    0x3: "voltage",
    0x4: "temperature",
    0x5: "hardware",
    0x6: "software",
    0x7: "additional modules",
    0x8: "monitoring",
    0x9: "external error",
    0xF: "error of the vendor's own",
}


def describe_error(code: int) -> str:
    """Return an error code (EMCY's first two bytes, or 0x603F) as a person reads it."""
    text = _CODES.get(code) or _CLASSES.get(code >> 12, "unknown error")
    return f"0x{code:04X} {text}"
