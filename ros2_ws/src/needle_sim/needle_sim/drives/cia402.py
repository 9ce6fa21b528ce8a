"""CiA 402: the power state machine of a drive, and its objects with their power-up values."""

from __future__ import annotations

import dataclasses
import enum
from functools import partial

from needle_sim.bus.object_dictionary import Kind, ObjectDictionary, one_of
from needle_sim.drives.motion_profile import METHODS
from needle_sim.drives.motor import MotorSettings


class PowerState(enum.Enum):
    """Power state, with its bits of the statusword (bits 0..3, 5 and 6)."""

    NOT_READY = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION = 0x0F
    FAULT = 0x08


class PowerCommand(enum.Enum):
    """Commands of a controlword to the power state machine: (mask, value)."""

    DISABLE_VOLTAGE = (0x02, 0x00)
    QUICK_STOP = (0x06, 0x02)
    SHUTDOWN = (0x07, 0x06)
    SWITCH_ON = (0x0F, 0x07)
    ENABLE_OPERATION = (0x0F, 0x0F)


FAULT_RESET = 0x80

_S, _O = PowerState, PowerCommand
# The numbers are those of the figure in the standard.
TRANSITIONS: dict[tuple[PowerState, PowerCommand], PowerState] = {
    (_S.SWITCH_ON_DISABLED, _O.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 2
    (_S.READY_TO_SWITCH_ON, _O.SWITCH_ON): _S.SWITCHED_ON,  # 3
    # Transitions 3 and 4 at once, as in most drives.
    (_S.READY_TO_SWITCH_ON, _O.ENABLE_OPERATION): _S.OPERATION_ENABLED,
    (_S.SWITCHED_ON, _O.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 4
    (_S.OPERATION_ENABLED, _O.SWITCH_ON): _S.SWITCHED_ON,  # 5
    (_S.SWITCHED_ON, _O.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 6
    (_S.READY_TO_SWITCH_ON, _O.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 7
    (_S.READY_TO_SWITCH_ON, _O.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 7
    (_S.OPERATION_ENABLED, _O.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 8
    (_S.OPERATION_ENABLED, _O.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 9
    (_S.SWITCHED_ON, _O.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 10
    (_S.SWITCHED_ON, _O.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 10
    (_S.OPERATION_ENABLED, _O.QUICK_STOP): _S.QUICK_STOP_ACTIVE,  # 11
    (_S.QUICK_STOP_ACTIVE, _O.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 12
    (_S.QUICK_STOP_ACTIVE, _O.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 16
}


def decode_command(controlword: int) -> PowerCommand | None:
    """Return the command of a controlword; None if it has none."""
    every = ((command, *command.value) for command in PowerCommand)
    return next((command for command, mask, value in every if controlword & mask == value), None)


def next_state(state: PowerState, controlword: int) -> PowerState:
    """Return the next state after a controlword."""
    command = decode_command(controlword)
    return state if command is None else TRANSITIONS.get((state, command), state)


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
THEN_OFF, _THEN_HOLD = 2, 6
"""Quick stop options (0x605A): brake on the ramp, then switch off or hold."""
AT_ONCE, _ON_RAMP = 0, 1
"""Options for switching off (0x605B, 0x605C): at once, or after a ramp."""
STEPPER = 0x0004_0192
SERVO = 0x0002_0192
_MANUFACTURER = 0x0000_0000
_INT32_MIN, _INT32_MAX = Kind.I32.bounds
_VERSION = b"1.0"


@dataclasses.dataclass(frozen=True)
class EmulatedDriveSettings:
    """Settings of an emulated drive.

    Attributes
    ----------
    name : str
        Name of the axis.
    node_id : int
        Node id, 1..127.
    device_type : int
        Object 0x1000: stepper or servo.
    motor : MotorSettings
        Mechanics of the axis.
    boot_time : float
        Time from power-up to the boot-up message [s].
    rpm : float or None
        One rpm of the motor [counts/s], for a drive with speeds in rpm and ramps in rpm/s.
    """

    name: str
    node_id: int
    device_type: int
    motor: MotorSettings
    boot_time: float
    rpm: float | None = None


def drive_dictionary(settings: EmulatedDriveSettings) -> ObjectDictionary:
    """Return the object dictionary of a drive."""
    objects = ObjectDictionary()
    add = objects.add
    add(0x1000, 0, Kind.U32, settings.device_type)
    add(0x1008, 0, None, text=f"Emulated {settings.name} drive".encode())
    add(0x1009, 0, None, text=_VERSION)
    add(0x100A, 0, None, text=_VERSION)
    for k, value in enumerate((4, _MANUFACTURER, 0x402, 1, settings.node_id)):
        add(0x1018, k, Kind.U8 if k == 0 else Kind.U32, value)

    slow = max(round(1e-3 * settings.motor.counts_per_unit), 1)
    read_write = partial(add, writable=True)
    in_pdo = partial(add, mappable=True)
    both = partial(add, writable=True, mappable=True)
    in_pdo(ERROR_CODE, 0, Kind.U16)
    both(CONTROLWORD, 0, Kind.U16)
    in_pdo(STATUSWORD, 0, Kind.U16)
    for index, option, choices in (
        # A lost connection is a fault, which brakes.
        *((0x6007, 1, (1,)), (0x605E, 2, (2,))),
        *((0x605A, THEN_OFF, (THEN_OFF, _THEN_HOLD)), (0x605B, AT_ONCE, (AT_ONCE, _ON_RAMP))),
        (0x605C, _ON_RAMP, (AT_ONCE, _ON_RAMP)),
    ):
        read_write(index, 0, Kind.I16, option, check=one_of(choices))
    read_write(0x605D, 0, Kind.I16, 1)
    both(MODE, 0, Kind.I8, check=one_of(MODES))
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
    both(0x6098, 0, Kind.I8, 0, check=one_of((0, *METHODS)))
    add(0x6099, 0, Kind.U8, 2)
    both(0x6099, 1, Kind.U32, slow)
    both(0x6099, 2, Kind.U32, max(slow // 10, 1))
    # The codes of CiA 303-2: prefix, numerator, denominator.
    units = [0x00B5_0000, 0x00B5_0300, 0x00B5_5700]
    if settings.rpm is not None:
        units[1:] = 0x00B4_4700, 0x00C0_0300
        for k, value in enumerate((2, round(60.0 * settings.rpm), 1)):
            add(0x608F, k, Kind.U8 if k == 0 else Kind.U32, value)
    for k, code in enumerate(units):
        add(0x60A8 + k, 0, Kind.U32, code)
    add(0x60C2, 0, Kind.U8, 2)
    read_write(0x60C2, 1, Kind.U8, 20)
    read_write(0x60C2, 2, Kind.I8, -3)
    in_pdo(0x60FD, 0, Kind.U32)
    add(0x6502, 0, Kind.U32, SUPPORTED_MODES)
    return objects
