"""Set-up of a drive over SDO: limits, reactions, process data, watchdog."""

from __future__ import annotations

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
from needle_device_driver.cia402.drive_units import read_units
from needle_device_driver.cia402.pdo_setup import map_pdo, silence_unused
from needle_device_driver.link import objects as od
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.object_access import DriveError, DriveRefusalError, ObjectAccess
from needle_device_driver.procedure import Procedure

# Milliseconds between a drive's heartbeats: well inside the reply age limit.
PRODUCER_HEARTBEAT_MS = 30
# Where the drive's own is fixed: what a start, and a drive that stands still, are waited for.
_SLOWEST_HEARTBEAT_MS = 200
# In seconds.
_SWITCH_OFF_WAIT = 1.0
_MODE_WAIT = 0.5

_LEFT_OUT = "has no {}: check on the rig what it does there (docs/hardware.md)"
_KEPT = "keeps its own {} (refused {}): check on the rig what it does there (docs/hardware.md)"
NO_INPUTS = "has no digital inputs to map: a retraction ends at 0 only, not at the switch"
_NO_FOLLOWING_ERROR = (
    "has no following error to map: an axis that is stopped while it is blocked is pulled on by up "
    "to the following error window when it comes free"
)


def set_up(
    link: FrameLink, monitor: DriveMonitor, settings: DriveSettings, *, period: float, homed: bool
) -> Procedure[tuple[DriveSettings, tuple[str, ...]]]:
    """Set a drive up from whatever state it is in; moves nothing, switches a powered one off.

    Parameters
    ----------
    link : FrameLink
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
    DriveSettings
        As given, with the units of the drive.
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
    profile = (yield from access.read(od.DEVICE_TYPE)) & 0xFFFF
    monitor.forget_start()
    if profile != od.CIA402:
        raise DriveError(f"node {node} is of device profile {profile}, wanted {od.CIA402}")
    # Not while this set-up keeps the loop from its heartbeat.
    yield from access.write(od.CONSUMER_HEARTBEAT, 0)
    settings, assumed = yield from read_units(access, settings)
    missing = [assumed] if assumed else []
    if settings.actuated:
        missing += yield from _set_up_motion(link, access, settings, period)
        yield from write_limits(access, settings, homed=homed)
        yield from map_pdo(access, node, od.COMMAND)
        yield from map_pdo(access, node, od.SET_POINT)
    missing += yield from _map_full(access, node, od.STATUS, od.STATUS_WITHOUT_INPUTS, NO_INPUTS)
    if settings.actuated:
        missing += yield from _map_full(
            access, node, od.POSITION, od.POSITION_ALONE, _NO_FOLLOWING_ERROR
        )
    else:
        yield from map_pdo(access, node, od.POSITION_ALONE)
    yield from silence_unused(access)
    yield from access.offer(od.CYCLE_PERIOD, round(period * 1e6))
    yield from _write_heartbeat(access)
    link.send(od.NMT, bytes([od.NMT_START, node]))
    return settings, tuple(missing)


def write_limits(access: ObjectAccess, settings: DriveSettings, *, homed: bool) -> Procedure[None]:
    """Set the drive's software limits: none while un-homed, for they count from home."""
    if homed:
        yield from _write_limits(access, *settings.limits_counts)
        return
    refusals = []
    for lower, upper in od.NO_LIMITS:
        try:
            yield from _write_limits(access, lower, upper)
        except DriveRefusalError as error:
            refusals.append(error)
        else:
            return
    raise refusals[0]


def write_homing(access: ObjectAccess, settings: DriveSettings, speed: float) -> Procedure[None]:
    """Set the speeds of a homing; `speed` in unit/s, at least one of the drive's own units."""
    if speed * settings.counts_per_unit < settings.speed_unit:
        raise DriveError(f"homing at {speed:g}/s is less than one of the drive's units of speed")
    yield from access.write(od.HOMING_SPEED_SWITCH, settings.magnitude(speed, settings.speed_unit))
    # Slow on the edge that counts.
    yield from access.write(
        od.HOMING_SPEED_ZERO, settings.magnitude(speed / 4.0, settings.speed_unit)
    )


def _write_limits(access: ObjectAccess, lower: int, upper: int) -> Procedure[None]:
    yield from access.write_checked(od.LOWER_LIMIT, lower, variable=True)
    yield from access.write_checked(od.UPPER_LIMIT, upper, variable=True)


def _set_up_motion(
    link: FrameLink, access: ObjectAccess, settings: DriveSettings, period: float
) -> Procedure[list[str]]:
    yield from _switch_off(link, access, settings)
    yield from _check_modes(link, access, settings.node_id)
    # Quick stop on its ramp, and stay: no set-point from before moves the axis afterwards.
    yield from access.write_checked(od.QUICK_STOP_OPTION, 6)
    # The node keeps its state: whether it exchanges process data tells a reboot.
    yield from access.offer(od.ERROR_BEHAVIOUR, 1)
    yield from _write_homing_method(access, settings.homing_method)
    window = settings.magnitude(settings.following_error)
    speed = settings.magnitude(settings.speed, settings.speed_unit)
    ramp = settings.magnitude(settings.acceleration, settings.ramp_unit)
    stop_ramp = settings.magnitude(settings.quick_stop_deceleration, settings.ramp_unit)
    # Entries that a drive may lack. Where a rule needs one: the least and the most that the drive
    # may round it to; less or more is clipped.
    wanted: list[tuple[od.Entry, int, tuple[int, int] | None]] = [
        # Ramps, never coasting; without the computer's heartbeat a fault, which latches.
        (od.SHUTDOWN_OPTION, 1, None),
        (od.DISABLE_OPTION, 1, None),
        (od.FAULT_REACTION_OPTION, 2, (2, 2)),
        (od.ABORT_CONNECTION_OPTION, 1, (1, 1)),
        (od.FOLLOWING_WINDOW, window, (window // 2 + 1, window)),
        (od.FOLLOWING_TIMEOUT, round(settings.following_error_time * 1e3), None),
        (od.HOME_OFFSET, 0, (0, 0)),
        (od.MAX_PROFILE_VELOCITY, speed, None),
        (od.PROFILE_VELOCITY, speed, None),
        (od.PROFILE_ACCELERATION, ramp, None),
        (od.PROFILE_DECELERATION, ramp, None),
        (od.HOMING_ACCELERATION, ramp, None),
        (od.QUICK_STOP_DECELERATION, stop_ramp, (stop_ramp // 2 + 1, 2 * stop_ramp)),
        (od.INTERPOLATION_PERIOD, round(period * 1e3), (round(period * 1e3),) * 2),
        (od.INTERPOLATION_EXPONENT, -3, (-3, -3)),
    ]
    if settings.max_torque > 0.0:
        torque = round(settings.max_torque * 1e3)
        wanted.append((od.MAX_TORQUE, torque, (torque // 2 + 1, 2 * torque)))
    missing = []
    for entry, value, taken in wanted:
        missing.append((yield from _set(access, entry, value, taken)))
    return [text for text in missing if text]


def _write_heartbeat(access: ObjectAccess) -> Procedure[None]:
    try:
        yield from access.write(od.PRODUCER_HEARTBEAT, PRODUCER_HEARTBEAT_MS)
    except DriveRefusalError as error:
        if error.object_is_missing:
            raise
        if not 0 < (yield from access.read(od.PRODUCER_HEARTBEAT)) <= _SLOWEST_HEARTBEAT_MS:
            raise


def _check_modes(link: FrameLink, access: ObjectAccess, node: int) -> Procedure[None]:
    """Refuse a drive that lacks a mode; the drive is off.

    Without 0x6502 each mode is tried. Cyclic synchronous position is also tried where 0x6502 does
    not list it: an EPOS4 supports it all the same.
    """
    listed = yield from access.ask(od.SUPPORTED_MODES)
    if listed is not None and not listed & SUPPORTS_HOMING:
        raise DriveError(f"node {node} has no homing mode (0x6502 = 0x{listed:08X})")
    if listed is None:
        yield from _try_mode(link, access, node, Mode.HOMING)
    if listed is None or not listed & SUPPORTS_CYCLIC_POSITION:
        yield from _try_mode(link, access, node, Mode.CYCLIC_SYNCHRONOUS_POSITION)


def _try_mode(link: FrameLink, access: ObjectAccess, node: int, mode: Mode) -> Procedure[None]:
    """Refuse a drive that does not take a mode, or does not show it."""
    yield from access.write(od.MODE_OF_OPERATION, mode)
    until = link.now + _MODE_WAIT
    while (shown := (yield from access.read(od.MODE_DISPLAY))) != mode:
        if link.now > until:
            raise DriveError(
                f"node {node} has no {mode.name.lower().replace('_', ' ')} mode "
                f"(0x6060 = {mode}, 0x6061 = {shown})"
            )


def _set(
    access: ObjectAccess, entry: od.Entry, value: int, taken: tuple[int, int] | None
) -> Procedure[str]:
    """Write an entry; return what the drive lacks. It may refuse an entry that no rule needs."""
    try:
        if taken is None:
            yield from access.write(entry, value)
        else:
            yield from access.write_checked(entry, value, taken=taken)
    except DriveRefusalError as error:
        if error.object_is_missing:
            return _LEFT_OUT.format(entry)
        if taken is not None:
            raise
        return _KEPT.format(entry, value)
    return ""


def _switch_off(link: FrameLink, access: ObjectAccess, settings: DriveSettings) -> Procedure[None]:
    """Switch off what another program left on: a powered drive takes no settings."""
    if drive_state((yield from access.read(od.STATUSWORD))) not in POWERED:
        return
    yield from access.write(od.CONTROLWORD, DriveCommand.DISABLE_VOLTAGE)
    until = link.now + _SWITCH_OFF_WAIT
    while drive_state((yield from access.read(od.STATUSWORD))) in POWERED:
        if link.now > until:
            raise DriveError(f"node {settings.node_id} does not switch off")


def _write_homing_method(access: ObjectAccess, method: int) -> Procedure[None]:
    try:
        yield from access.write(od.HOMING_METHOD, method)
    except DriveRefusalError:
        if method not in HERE:
            raise
        # Two numbers for "where it stands": 35 is the older edition's.
        for other in HERE:
            if other != method:
                yield from access.write(od.HOMING_METHOD, other)


def _map_full(
    access: ObjectAccess, node: int, full: od.Pdo, without: od.Pdo, missing: str
) -> Procedure[list[str]]:
    """Map a PDO with its last entry where the drive can; return what it lacks."""
    try:
        if (yield from access.ask(full.entries[-1])) is not None:
            yield from map_pdo(access, node, full)
            return []
    except DriveRefusalError:
        # Either the entry cannot be mapped, or the next attempt tells what else it is.
        pass
    yield from map_pdo(access, node, without)
    return [missing]
