"""How a drive is set up over SDO: limits, reactions, process data, watchdog."""

from __future__ import annotations

from collections.abc import Callable

from needle_device_driver import objects as od
from needle_device_driver.can_link import CanLink
from needle_device_driver.cia402 import (
    FAULTS,
    POWERED,
    SUPPORTS_CYCLIC_POSITION,
    SUPPORTS_HOMING,
    DriveCommand,
    drive_state,
)
from needle_device_driver.drive_monitor import DriveMonitor
from needle_device_driver.drive_settings import DriveSettings
from needle_device_driver.emergency import describe_error
from needle_device_driver.object_access import DriveError, ObjectAccess, send_heartbeat
from needle_device_driver.objects import Pdo

# Milliseconds between a drive's heartbeats: well inside the reply age limit.
PRODUCER_HEARTBEAT_MS = 30
# In seconds.
_HEARTBEAT_WAIT = 0.3
_FAULT_RESET_WAIT = 1.0


# A rule depends on these: what the drive made of them is read back.
_CHECKED = (od.ABORT_CONNECTION_OPTION, od.FAULT_REACTION_OPTION, od.FOLLOWING_WINDOW)
# Entries that CiA 402 leaves to the maker and that no rule hangs on alone.
_LEFT_OUT = (
    "has no {}: check on the rig what it does there (docs/hardware.md)",
    "has no digital inputs to map: a retraction ends at 0 only, not at the switch",
)


def set_up(
    link: CanLink, settings: DriveSettings, *, period: float, homed: bool
) -> tuple[str, ...]:
    """Set a drive up from whatever state it is in; moves nothing, switches a powered one off.

    Parameters
    ----------
    link : CanLink
        The bus, open.
    settings : DriveSettings
        What the drive shall be.
    period : float
        Of the SYNC [s].
    homed : bool
        Whether its position counts from home, so that software limits mean something.

    Returns
    -------
    tuple of str
        What the drive lacks that it could be without.

    Raises
    ------
    DriveError
        If the node does not answer, is no CiA 402 drive, or lacks what is needed.
    LinkError
        If the link is lost.
    """
    node = settings.node_id
    access = ObjectAccess(link, node)
    link.send(od.NMT, bytes([od.NMT_PRE_OPERATIONAL, node]))
    profile = access.read(od.DEVICE_TYPE) & 0xFFFF
    if profile != od.CIA402:
        raise DriveError(f"node {node} is of device profile {profile}, wanted {od.CIA402}")
    # Not while this set-up keeps the loop from its heartbeat.
    access.write(od.CONSUMER_HEARTBEAT, 0)
    lacking: list[str] = []
    if settings.actuated:
        lacking += _set_up_motion(access, settings, period)
        write_limits(access, settings, homed=homed)
        _map(access, node, od.COMMAND)
        _map(access, node, od.SET_POINT)
    if access.has(od.DIGITAL_INPUTS):
        _map(access, node, od.STATUS)
    else:
        lacking.append(_LEFT_OUT[1])
        _map(access, node, od.STATUS_WITHOUT_INPUTS)
    _map(access, node, od.POSITION)
    access.write_optional(od.CYCLE_PERIOD, round(period * 1e6))
    access.write(od.PRODUCER_HEARTBEAT, PRODUCER_HEARTBEAT_MS)
    link.send(od.NMT, bytes([od.NMT_START, node]))
    return tuple(lacking)


def arm_watchdog(link: CanLink, settings: DriveSettings, watchdog: float) -> None:
    """Let the drive stop without the computer's heartbeat for `watchdog` [s]; raises as `set_up`.

    It is the last step of a set-up: from here on the loop must send its heartbeat.
    """
    if settings.actuated:
        ObjectAccess(link, settings.node_id).write_checked(
            od.CONSUMER_HEARTBEAT, od.MASTER_NODE_ID << 16 | round(watchdog * 1e3)
        )


def await_operational(link: CanLink, monitor: DriveMonitor, period: float) -> bool:
    """Return whether the drive's heartbeat says: operational; the computer's goes on meanwhile."""
    until = link.clock() + _HEARTBEAT_WAIT
    while link.clock() < until:
        send_heartbeat(link)
        if monitor.await_operational(period):
            return True
    return False


def reset_fault(access: ObjectAccess, clock: Callable[[], float]) -> None:
    """Acknowledge a drive's fault and wait until it is gone; moves nothing.

    Parameters
    ----------
    access : ObjectAccess
        The drive.
    clock : callable
        Steady time [s].

    Raises
    ------
    DriveError
        If the drive does not answer, or stays in its fault.
    LinkError
        If the link is lost.
    """
    if drive_state(access.read(od.STATUSWORD)) not in FAULTS:
        return
    # The rising edge counts.
    access.write(od.CONTROLWORD, DriveCommand.DISABLE_VOLTAGE)
    access.write(od.CONTROLWORD, DriveCommand.FAULT_RESET)
    until = clock() + _FAULT_RESET_WAIT
    while drive_state(access.read(od.STATUSWORD)) in FAULTS:
        if clock() > until:
            code = describe_error(access.read(od.ERROR_CODE))
            raise DriveError(f"the drive does not leave its fault: {code}")
    access.write(od.CONTROLWORD, DriveCommand.DISABLE_VOLTAGE)


def disarm_watchdog(link: CanLink, settings: DriveSettings) -> None:
    """Let the drive go without the computer, which takes its leave; raises as `set_up`."""
    if settings.actuated:
        ObjectAccess(link, settings.node_id).write(od.CONSUMER_HEARTBEAT, 0)


def write_limits(access: ObjectAccess, settings: DriveSettings, *, homed: bool) -> None:
    """Set the drive's software limits: none while un-homed, for they count from home."""
    lower, upper = settings.limits_counts if homed else (od.NO_LOWER_LIMIT, od.NO_UPPER_LIMIT)
    access.write_checked(od.LOWER_LIMIT, lower)
    access.write_checked(od.UPPER_LIMIT, upper)


def write_homing(access: ObjectAccess, settings: DriveSettings, speed: float) -> None:
    """Set method and speeds of a homing; `speed` in unit/s."""
    access.write(od.HOMING_METHOD, settings.homing_method)
    access.write(od.HOMING_SPEED_SWITCH, settings.magnitude(speed))
    # Slow on the edge that counts.
    access.write(od.HOMING_SPEED_ZERO, settings.magnitude(speed / 4.0))
    access.write(od.HOMING_ACCELERATION, settings.magnitude(settings.acceleration))


def _set_up_motion(access: ObjectAccess, settings: DriveSettings, period: float) -> list[str]:
    modes = access.read(od.SUPPORTED_MODES)
    for bit, name in (
        (SUPPORTS_CYCLIC_POSITION, "cyclic synchronous position"),
        (SUPPORTS_HOMING, "homing"),
    ):
        if not modes & bit:
            raise DriveError(f"node {settings.node_id} has no {name} mode (0x6502 = 0x{modes:08X})")
    if drive_state(access.read(od.STATUSWORD)) in POWERED:
        access.write(od.CONTROLWORD, DriveCommand.DISABLE_VOLTAGE)
    # Quick stop on its ramp, and stay: no set-point from before moves the axis afterwards.
    access.write_checked(od.QUICK_STOP_OPTION, 6)
    # The node keeps its state: whether it exchanges process data tells a reboot.
    access.write_optional(od.ERROR_BEHAVIOUR, 1)
    magnitude = settings.magnitude
    wanted = [
        # Ramps, never coasting; without the computer's heartbeat a fault, which latches.
        (od.SHUTDOWN_OPTION, 1),
        (od.DISABLE_OPTION, 1),
        (od.FAULT_REACTION_OPTION, 2),
        (od.ABORT_CONNECTION_OPTION, 1),
        (od.FOLLOWING_WINDOW, magnitude(settings.following_error)),
        (od.FOLLOWING_TIMEOUT, round(settings.following_error_time * 1e3)),
        (od.HOME_OFFSET, 0),
        (od.MAX_PROFILE_VELOCITY, magnitude(settings.speed)),
        (od.PROFILE_VELOCITY, magnitude(settings.speed)),
        (od.PROFILE_ACCELERATION, magnitude(settings.acceleration)),
        (od.PROFILE_DECELERATION, magnitude(settings.acceleration)),
        (od.QUICK_STOP_DECELERATION, magnitude(settings.quick_stop_deceleration)),
        (od.INTERPOLATION_PERIOD, round(period * 1e3)),
        (od.INTERPOLATION_EXPONENT, -3),
    ]
    if settings.max_torque > 0.0:
        wanted.append((od.MAX_TORQUE, round(settings.max_torque * 1e3)))
    return [
        _LEFT_OUT[0].format(entry)
        for entry, value in wanted
        if not access.write_optional(entry, value, checked=entry in _CHECKED)
    ]


def _map(access: ObjectAccess, node: int, pdo: Pdo) -> None:
    """Set a PDO up in the order that CiA 301 wants: off, type, mapping, on."""
    cob_id = od.Entry(pdo.communication, 1, od.U32, "COB-ID")
    transmission = od.Entry(pdo.communication, 2, od.U8, "transmission type")
    count = od.Entry(pdo.mapping, 0, od.U8, "number of mapped entries")
    address = pdo.function_code + node
    access.write(cob_id, od.PDO_OFF | address)
    access.write(transmission, pdo.transmission)
    access.write(count, 0)
    for number, entry in enumerate(pdo.entries, start=1):
        access.write(od.Entry(pdo.mapping, number, od.U32, "mapped entry"), entry.mapping)
    access.write(count, len(pdo.entries))
    access.write(cob_id, address)
