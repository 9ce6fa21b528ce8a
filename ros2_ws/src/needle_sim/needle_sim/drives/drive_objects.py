"""The objects of a CiA 402 drive, with their values after power-up."""

from __future__ import annotations

from functools import partial

from needle_sim.bus.object_dictionary import Kind, ObjectDictionary

PROFILE_POSITION = 1
HOMING = 6
CYCLIC_SYNCHRONOUS_POSITION = 8
MODES = (0, PROFILE_POSITION, HOMING, CYCLIC_SYNCHRONOUS_POSITION)
SUPPORTED_MODES = sum(1 << mode - 1 for mode in MODES if mode)

CONTROLWORD = 0x6040
STATUSWORD = 0x6041
ERROR_CODE = 0x603F
TARGET_POSITION = 0x607A
POSITION = 0x6064
MODE = 0x6060
STEPPER = 0x0004_0192
SERVO = 0x0002_0192
_MANUFACTURER = 0x0000_0000
_INT32_MIN, _INT32_MAX = Kind.I32.bounds
_VERSION = b"1.0"


def drive_dictionary(
    name: str, device_type: int, number: int, *, counts_per_unit: float, rpm: float | None
) -> ObjectDictionary:
    """Return the dictionary of one drive.

    Parameters
    ----------
    name : str
        Its axis; part of the device's name.
    device_type : int
        Object 0x1000.
    number : int
        Its serial number.
    counts_per_unit : float
        Sets speeds and ramps after power-up to something slow.
    rpm : float or None
        One rpm of the motor [counts/s], for a drive that takes speeds in it; None: counts/s.
    """
    objects = ObjectDictionary()
    add = objects.add
    add(0x1000, 0, Kind.U32, device_type)
    add(0x1008, 0, None, text=f"Emulated {name} drive".encode())
    add(0x1009, 0, None, text=_VERSION)
    add(0x100A, 0, None, text=_VERSION)
    for k, value in enumerate((4, _MANUFACTURER, 0x402, 1, number)):
        add(0x1018, k, Kind.U8 if k == 0 else Kind.U32, value)

    slow = max(round(1e-3 * counts_per_unit), 1)
    read_write = partial(add, writable=True)
    in_pdo = partial(add, mappable=True)
    both = partial(add, writable=True, mappable=True)
    in_pdo(ERROR_CODE, 0, Kind.U16)
    read_write(0x6007, 0, Kind.I16, 1)
    both(CONTROLWORD, 0, Kind.U16)
    in_pdo(STATUSWORD, 0, Kind.U16)
    for index, option in ((0x605A, 2), (0x605B, 0), (0x605C, 1), (0x605D, 1), (0x605E, 2)):
        read_write(index, 0, Kind.I16, option)
    both(MODE, 0, Kind.I8)
    in_pdo(0x6061, 0, Kind.I8)
    for index in (0x6062, POSITION, 0x606C, 0x60F4):
        in_pdo(index, 0, Kind.I32)
    read_write(0x6065, 0, Kind.U32, slow)
    read_write(0x6066, 0, Kind.U16, 0)
    read_write(0x6067, 0, Kind.U32, 10)
    read_write(0x6068, 0, Kind.U16, 0)
    both(0x6072, 0, Kind.U16, 1000)
    in_pdo(0x6077, 0, Kind.I16)
    both(TARGET_POSITION, 0, Kind.I32)
    read_write(0x607C, 0, Kind.I32, 0)
    add(0x607D, 0, Kind.U8, 2)
    read_write(0x607D, 1, Kind.I32, _INT32_MIN)
    read_write(0x607D, 2, Kind.I32, _INT32_MAX)
    both(0x607F, 0, Kind.U32, 0xFFFFFFFF)
    both(0x6081, 0, Kind.U32, slow)
    for index in (0x6083, 0x6084, 0x6085, 0x609A):
        both(index, 0, Kind.U32, 10 * slow)
    both(0x6098, 0, Kind.I8, 0)
    add(0x6099, 0, Kind.U8, 2)
    both(0x6099, 1, Kind.U32, slow)
    both(0x6099, 2, Kind.U32, max(slow // 10, 1))
    # The codes of CiA 303-2: prefix, numerator, denominator.
    units = [0x00B5_0000, 0x00B5_0300, 0x00B5_5700]
    if rpm is not None:
        units[1:] = 0x00B4_4700, 0x00C0_0300
        for k, value in enumerate((2, round(60.0 * rpm), 1)):
            add(0x608F, k, Kind.U8 if k == 0 else Kind.U32, value)
    for k, code in enumerate(units):
        add(0x60A8 + k, 0, Kind.U32, code)
    add(0x60C2, 0, Kind.U8, 2)
    read_write(0x60C2, 1, Kind.U8, 20)
    read_write(0x60C2, 2, Kind.I8, -3)
    in_pdo(0x60FD, 0, Kind.U32)
    add(0x6502, 0, Kind.U32, SUPPORTED_MODES)
    return objects
