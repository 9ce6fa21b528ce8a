"""Set-up of a drive over SDO: limits, reactions, process data, watchdog."""

from __future__ import annotations

import enum

from needle_device_driver.cia402.cia402 import (
    POWERED,
    SUPPORTS_CYCLIC_POSITION,
    SUPPORTS_HOMING,
    DriveCommand,
    Mode,
    drive_state,
)
from needle_device_driver.cia402.drive_monitor import DriveMonitor
from needle_device_driver.cia402.drive_settings import HERE, DriveSettings
from needle_device_driver.cia402.pdo_setup import map_pdo, silence_unused
from needle_device_driver.link import objects as od
from needle_device_driver.link.can_link import CanLink
from needle_device_driver.link.object_access import DriveError, DriveRefusalError, ObjectAccess

# Milliseconds between a drive's heartbeats: well inside the reply age limit.
PRODUCER_HEARTBEAT_MS = 30
# Where the drive's own is fixed: what a start, and a drive that stands still, are waited for.
_SLOWEST_HEARTBEAT_MS = 200
# In seconds.
_SWITCH_OFF_WAIT = 1.0

_LEFT_OUT = "has no {}: check on the rig what it does there (docs/hardware.md)"
_KEPT = "keeps its own {} (refused {}): check on the rig what it does there (docs/hardware.md)"
_NO_INPUTS = "has no digital inputs to map: a retraction ends at 0 only, not at the switch"
_NO_FOLLOWING_ERROR = (
    "has no following error to map: an axis that is stopped while it is blocked is pulled on by up "
    "to the following error window when it comes free"
)


class _Need(enum.Enum):
    """Weight of an entry that a drive need not have; one that it has is set."""

    # A drive that refuses keeps its own.
    WISH = enum.auto()
    # A rule depends on these: what the drive made of them is read back. Rounded is not clipped.
    ROUNDED = enum.auto()
    ROUNDED_DOWN = enum.auto()
    EXACT = enum.auto()


def set_up(
    link: CanLink, monitor: DriveMonitor, settings: DriveSettings, *, period: float, homed: bool
) -> tuple[str, ...]:
    """Set a drive up from whatever state it is in; moves nothing, switches a powered one off.

    Parameters
    ----------
    link : CanLink
        The bus, open.
    monitor : DriveMonitor
        The drive's; a start that it hears of once the drive has answered voids the set-up.
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
    monitor.forget_start()
    if profile != od.CIA402:
        raise DriveError(f"node {node} is of device profile {profile}, wanted {od.CIA402}")
    # Not while this set-up keeps the loop from its heartbeat.
    access.write(od.CONSUMER_HEARTBEAT, 0)
    missing: list[str] = []
    if settings.actuated:
        missing += _set_up_motion(link, access, settings, period)
        write_limits(access, settings, homed=homed)
        map_pdo(access, node, od.COMMAND)
        map_pdo(access, node, od.SET_POINT)
    missing += _map_full(access, node, od.STATUS, od.STATUS_WITHOUT_INPUTS, _NO_INPUTS)
    if settings.actuated:
        missing += _map_full(access, node, od.POSITION, od.POSITION_ALONE, _NO_FOLLOWING_ERROR)
    else:
        map_pdo(access, node, od.POSITION_ALONE)
    silence_unused(access)
    access.offer(od.CYCLE_PERIOD, round(period * 1e6))
    _write_heartbeat(access)
    link.send(od.NMT, bytes([od.NMT_START, node]))
    return tuple(missing)


def write_limits(access: ObjectAccess, settings: DriveSettings, *, homed: bool) -> None:
    """Set the drive's software limits: none while un-homed, for they count from home."""
    if homed:
        _write_limits(access, *settings.limits_counts)
        return
    refusals = []
    for lower, upper in od.NO_LIMITS:
        try:
            _write_limits(access, lower, upper)
        except DriveRefusalError as error:
            refusals.append(error)
        else:
            return
    raise refusals[0]


def write_homing(access: ObjectAccess, settings: DriveSettings, speed: float) -> None:
    """Set the speeds of a homing; `speed` in unit/s."""
    access.write(od.HOMING_SPEED_SWITCH, settings.magnitude(speed))
    # Slow on the edge that counts.
    access.write(od.HOMING_SPEED_ZERO, settings.magnitude(speed / 4.0))


def _write_limits(access: ObjectAccess, lower: int, upper: int) -> None:
    access.write_checked(od.LOWER_LIMIT, lower, variable=True)
    access.write_checked(od.UPPER_LIMIT, upper, variable=True)


def _set_up_motion(
    link: CanLink, access: ObjectAccess, settings: DriveSettings, period: float
) -> list[str]:
    listed = _lists_modes(access, settings.node_id)
    _switch_off(link, access, settings)
    if not listed:
        # It refuses to be in a mode that it lacks.
        for mode in (Mode.HOMING, Mode.CYCLIC_SYNCHRONOUS_POSITION):
            access.write(od.MODE_OF_OPERATION, mode)
    # Quick stop on its ramp, and stay: no set-point from before moves the axis afterwards.
    access.write_checked(od.QUICK_STOP_OPTION, 6)
    # The node keeps its state: whether it exchanges process data tells a reboot.
    access.offer(od.ERROR_BEHAVIOUR, 1)
    _write_homing_method(access, settings.homing_method)
    magnitude = settings.magnitude
    wanted = [
        # Ramps, never coasting; without the computer's heartbeat a fault, which latches.
        (od.SHUTDOWN_OPTION, 1, _Need.WISH),
        (od.DISABLE_OPTION, 1, _Need.WISH),
        (od.FAULT_REACTION_OPTION, 2, _Need.EXACT),
        (od.ABORT_CONNECTION_OPTION, 1, _Need.EXACT),
        (od.FOLLOWING_WINDOW, magnitude(settings.following_error), _Need.ROUNDED_DOWN),
        (od.FOLLOWING_TIMEOUT, round(settings.following_error_time * 1e3), _Need.WISH),
        (od.HOME_OFFSET, 0, _Need.EXACT),
        (od.MAX_PROFILE_VELOCITY, magnitude(settings.speed), _Need.WISH),
        (od.PROFILE_VELOCITY, magnitude(settings.speed), _Need.WISH),
        (od.PROFILE_ACCELERATION, magnitude(settings.acceleration), _Need.WISH),
        (od.PROFILE_DECELERATION, magnitude(settings.acceleration), _Need.WISH),
        (od.HOMING_ACCELERATION, magnitude(settings.acceleration), _Need.WISH),
        (od.QUICK_STOP_DECELERATION, magnitude(settings.quick_stop_deceleration), _Need.ROUNDED),
        (od.INTERPOLATION_PERIOD, round(period * 1e3), _Need.EXACT),
        (od.INTERPOLATION_EXPONENT, -3, _Need.EXACT),
    ]
    if settings.max_torque > 0.0:
        wanted.append((od.MAX_TORQUE, round(settings.max_torque * 1e3), _Need.ROUNDED))
    missing = (_set(access, entry, value, need) for entry, value, need in wanted)
    return [text for text in missing if text]


def _write_heartbeat(access: ObjectAccess) -> None:
    try:
        access.write(od.PRODUCER_HEARTBEAT, PRODUCER_HEARTBEAT_MS)
    except DriveRefusalError as error:
        if error.object_is_missing:
            raise
        if not 0 < access.read(od.PRODUCER_HEARTBEAT) <= _SLOWEST_HEARTBEAT_MS:
            raise


def _lists_modes(access: ObjectAccess, node: int) -> bool:
    """Return whether a drive says which modes it has; raises where a needed one is not there."""
    try:
        modes = access.read(od.SUPPORTED_MODES)
    except DriveRefusalError as error:
        if error.object_is_missing:
            return False
        raise
    for bit, name in (
        (SUPPORTS_CYCLIC_POSITION, "cyclic synchronous position"),
        (SUPPORTS_HOMING, "homing"),
    ):
        if not modes & bit:
            raise DriveError(f"node {node} has no {name} mode (0x6502 = 0x{modes:08X})")
    return True


def _set(access: ObjectAccess, entry: od.Entry, value: int, need: _Need) -> str:
    """Write an entry as far as it is needed; return what the drive lacks."""
    try:
        if need is _Need.EXACT:
            access.write_checked(entry, value)
        elif need is _Need.ROUNDED:
            access.write_checked(entry, value, at_least=value // 2 + 1, at_most=2 * value)
        elif need is _Need.ROUNDED_DOWN:
            access.write_checked(entry, value, at_least=value // 2 + 1)
        else:
            access.write(entry, value)
    except DriveRefusalError as error:
        if error.object_is_missing:
            return _LEFT_OUT.format(entry)
        if need is not _Need.WISH:
            raise
        return _KEPT.format(entry, value)
    return ""


def _switch_off(link: CanLink, access: ObjectAccess, settings: DriveSettings) -> None:
    """Switch off what another program left on: a powered drive takes no settings."""
    if drive_state(access.read(od.STATUSWORD)) not in POWERED:
        return
    access.write(od.CONTROLWORD, DriveCommand.DISABLE_VOLTAGE)
    until = link.clock() + _SWITCH_OFF_WAIT
    while drive_state(access.read(od.STATUSWORD)) in POWERED:
        if link.clock() > until:
            raise DriveError(f"node {settings.node_id} does not switch off")


def _write_homing_method(access: ObjectAccess, method: int) -> None:
    try:
        access.write(od.HOMING_METHOD, method)
    except DriveRefusalError:
        if method not in HERE:
            raise
        # Two numbers for "where it stands": 35 is the older edition's.
        for other in HERE:
            if other != method:
                access.write(od.HOMING_METHOD, other)


def _map_full(
    access: ObjectAccess, node: int, full: od.Pdo, without: od.Pdo, missing: str
) -> list[str]:
    """Map a PDO with its last entry where the drive can; return what it lacks."""
    try:
        if access.has(full.entries[-1]):
            map_pdo(access, node, full)
            return []
    except DriveRefusalError:
        # Either the entry cannot be read or mapped, or the next attempt tells what else it is.
        pass
    map_pdo(access, node, without)
    return [missing]
