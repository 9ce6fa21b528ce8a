"""Set-up of a drive over SDO: limits, reactions, process data."""

from __future__ import annotations

from collections.abc import Iterable

from needle_device_driver.axes.axis_settings import PRESENT_POSITION_METHODS
from needle_device_driver.axes.link import DriveError
from needle_device_driver.cia402.cia402 import (
    POWERED,
    SUPPORTS_CYCLIC_POSITION,
    SUPPORTS_HOMING,
    DriveCommand,
    Mode,
    drive_state,
)
from needle_device_driver.cia402.drive_monitor import DriveMonitor
from needle_device_driver.cia402.drive_settings import DriveSettings, read_units
from needle_device_driver.link import objects as od
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.object_access import DriveRefusalError, ObjectAccess, ObjectError
from needle_device_driver.link.objects import Pdo
from needle_device_driver.procedure import Procedure

# Milliseconds between a drive's heartbeats: much shorter than the reply age limit.
PRODUCER_HEARTBEAT_MS = 30
# Longest accepted heartbeat period if a drive refuses the one above: the driver waits for
# heartbeats when a drive starts, and while it stands still.
_MAX_HEARTBEAT_MS = 200
# Time-outs [s].
_SWITCH_OFF_TIMEOUT = 1.0
_MODE_TIMEOUT = 0.5
# Two of the four transmit PDOs that CiA 402 drives have by default; they may be on.
_UNUSED_PDOS = (0x1802, 0x1803)
_FIRST_TRANSMIT_PDO = 0x1800

_LEFT_OUT = "has no {}: check the effect on the rig (docs/hardware.md)"
_KEPT = "keeps its own {} (refused {}): check the effect on the rig (docs/hardware.md)"
NO_INPUTS = "has no digital inputs to map: a retraction ends at 0, not at the switch"
_NO_FOLLOWING_ERROR = (
    "has no following error to map: an axis that stops while it is blocked can move by up to the "
    "following error window when it is freed"
)


def set_up(
    link: FrameLink, monitor: DriveMonitor, settings: DriveSettings, *, period: float, homed: bool
) -> Procedure[tuple[DriveSettings, tuple[str, ...]]]:
    """Set a drive up from any state; moves nothing, switches a powered drive off.

    Parameters
    ----------
    link : FrameLink
        The bus, open.
    monitor : DriveMonitor
        Monitor of the drive; a reboot after its first answer voids the set-up.
    settings : DriveSettings
        The requested settings.
    period : float
        SYNC period [s].
    homed : bool
        Whether the position counts from home, as the software limits do.

    Returns
    -------
    DriveSettings
        The given settings, with the units of the drive.
    tuple of str
        Optional objects that the drive lacks, and assumptions.

    Raises
    ------
    DriveError
        If the node does not answer, is not a CiA 402 drive, or lacks a required object.
    LinkError
        If the link is lost.
    """
    node = settings.node_id
    access = ObjectAccess(link, node)
    link.send(od.NMT, bytes([od.NMT_PRE_OPERATIONAL, node]))
    profile = (yield from access.read(od.DEVICE_TYPE)) & 0xFFFF
    monitor.clear_reboot()
    if profile != od.CIA402:
        raise DriveError(f"node {node} has device profile {profile}, expected {od.CIA402}")
    # The loop does not run during the set-up, so the watchdog must be off.
    yield from access.write(od.CONSUMER_HEARTBEAT, 0)
    settings, assumed = yield from read_units(access, settings)
    missing = [assumed] if assumed else []
    if settings.actuated:
        missing += yield from _set_up_motion(link, access, settings, period)
        yield from write_limits(access, settings, homed=homed)
        yield from _map_pdo(access, node, od.COMMAND)
        yield from _map_pdo(access, node, od.SET_POINT)
    missing += yield from _map_optional(
        access, node, od.STATUS, od.STATUS_WITHOUT_INPUTS, NO_INPUTS
    )
    if settings.actuated:
        missing += yield from _map_optional(
            access, node, od.POSITION, od.POSITION_ALONE, _NO_FOLLOWING_ERROR
        )
    else:
        yield from _map_pdo(access, node, od.POSITION_ALONE)
    yield from _switch_off_unused_pdos(access)
    yield from access.write_optional(od.CYCLE_PERIOD, round(period * 1e6))
    yield from _write_heartbeat(access)
    link.send(od.NMT, bytes([od.NMT_START, node]))
    return settings, tuple(missing)


def write_limits(access: ObjectAccess, settings: DriveSettings, *, homed: bool) -> Procedure[None]:
    """Write the drive's software limits, which count from home; before homing, disable them."""

    def write(lower: int, upper: int) -> Procedure[None]:
        yield from access.write_checked(od.LOWER_LIMIT, lower, variable=True)
        yield from access.write_checked(od.UPPER_LIMIT, upper, variable=True)

    limits = [settings.limits_counts] if homed else od.NO_LIMITS
    yield from _first_accepted(write(lower, upper) for lower, upper in limits)


def write_homing(access: ObjectAccess, settings: DriveSettings, speed: float) -> Procedure[None]:
    """Write the homing speeds; `speed` [unit/s] must be at least one of the drive's units."""
    if speed * settings.counts_per_unit < settings.speed_unit:
        raise DriveError(f"homing at {speed:g}/s is less than one speed unit of the drive")
    yield from access.write(od.HOMING_SPEED_SWITCH, settings.magnitude(speed, settings.speed_unit))
    # Leave the switch slowly: its edge defines the position.
    yield from access.write(
        od.HOMING_SPEED_ZERO, settings.magnitude(speed / 4.0, settings.speed_unit)
    )


# ---- motion -------------------------------------------------------------------------------------


def _set_up_motion(
    link: FrameLink, access: ObjectAccess, settings: DriveSettings, period: float
) -> Procedure[list[str]]:
    yield from _switch_off(link, access, settings)
    yield from _check_modes(link, access, settings.node_id)
    # Quick stop on its ramp, then hold: an earlier set-point must not move the axis afterwards.
    yield from access.write_checked(od.QUICK_STOP_OPTION, 6)
    # Keep the NMT state on an error: the driver detects a reboot by that state.
    yield from access.write_optional(od.ERROR_BEHAVIOUR, 1)
    yield from _write_homing_method(access, settings.homing_method)
    window = settings.magnitude(settings.following_error)
    speed = settings.magnitude(settings.speed, settings.speed_unit)
    ramp = settings.magnitude(settings.acceleration, settings.ramp_unit)
    stop_ramp = settings.magnitude(settings.quick_stop_deceleration, settings.ramp_unit)
    # Objects that a drive may lack: value, and if a rule depends on the object, the least and
    # greatest accepted value after rounding by the drive. A value outside them was clipped.
    objects: list[tuple[od.Entry, int, tuple[int, int] | None]] = [
        # Stop on ramps, never coast; a missing heartbeat is a fault, which latches.
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
    if settings.max_torque:
        torque = round(settings.max_torque * 1e3)
        objects.append((od.MAX_TORQUE, torque, (torque // 2 + 1, 2 * torque)))
    missing = []
    for entry, value, accepted in objects:
        missing.append((yield from _write_optional_object(access, entry, value, accepted)))
    return [text for text in missing if text]


def _write_optional_object(
    access: ObjectAccess, entry: od.Entry, value: int, accepted: tuple[int, int] | None
) -> Procedure[str]:
    """Write an object; return a note if it is missing, or refused and not needed by a rule."""
    try:
        if accepted is None:
            yield from access.write(entry, value)
        else:
            yield from access.write_checked(entry, value, accepted=accepted)
    except DriveRefusalError as error:
        if error.object_is_missing:
            return _LEFT_OUT.format(entry)
        if accepted is not None:
            raise
        return _KEPT.format(entry, value)
    return ""


def _switch_off(link: FrameLink, access: ObjectAccess, settings: DriveSettings) -> Procedure[None]:
    """Switch a powered drive off, because it may refuse settings."""
    if drive_state((yield from access.read(od.STATUSWORD))) not in POWERED:
        return
    yield from access.write(od.CONTROLWORD, DriveCommand.DISABLE_VOLTAGE)
    until = link.now + _SWITCH_OFF_TIMEOUT
    while drive_state((yield from access.read(od.STATUSWORD))) in POWERED:
        if link.now > until:
            raise DriveError(f"node {settings.node_id} does not switch off")


def _check_modes(link: FrameLink, access: ObjectAccess, node: int) -> Procedure[None]:
    """Check that a switched-off drive has both modes.

    Without 0x6502 each mode is tried. Cyclic synchronous position is also tried if 0x6502 does not
    list it, because an EPOS4 supports it without listing it.
    """
    listed = yield from access.read_optional(od.SUPPORTED_MODES)
    if listed is not None and not listed & SUPPORTS_HOMING:
        text = f"node {node} has no homing mode (0x6502 = 0x{listed:08X})"
        raise ObjectError(text, od.SUPPORTED_MODES)
    if listed is None:
        yield from _try_mode(link, access, node, Mode.HOMING)
    if listed is None or not listed & SUPPORTS_CYCLIC_POSITION:
        yield from _try_mode(link, access, node, Mode.CYCLIC_SYNCHRONOUS_POSITION)


def _try_mode(link: FrameLink, access: ObjectAccess, node: int, mode: Mode) -> Procedure[None]:
    """Select a mode, and wait until the drive displays it."""
    yield from access.write(od.MODE_OF_OPERATION, mode)
    until = link.now + _MODE_TIMEOUT
    while (shown := (yield from access.read(od.MODE_DISPLAY))) != mode:
        if link.now > until:
            raise DriveError(
                f"node {node} has no {mode.name.lower().replace('_', ' ')} mode "
                f"(0x6060 = {mode}, 0x6061 = {shown})"
            )


def _write_homing_method(access: ObjectAccess, method: int) -> Procedure[None]:
    # An older edition of the standard uses 35 for homing at the present position.
    others = PRESENT_POSITION_METHODS if method in PRESENT_POSITION_METHODS else ()
    methods = dict.fromkeys((method, *others))
    yield from _first_accepted(access.write(od.HOMING_METHOD, one) for one in methods)


def _write_heartbeat(access: ObjectAccess) -> Procedure[None]:
    try:
        yield from access.write(od.PRODUCER_HEARTBEAT, PRODUCER_HEARTBEAT_MS)
    except DriveRefusalError:
        if not 0 < (yield from access.read(od.PRODUCER_HEARTBEAT)) <= _MAX_HEARTBEAT_MS:
            raise


# ---- process data -------------------------------------------------------------------------------


def _map_optional(
    access: ObjectAccess, node: int, full: Pdo, without: Pdo, missing: str
) -> Procedure[list[str]]:
    """Map a PDO, without its last entry if the drive lacks it; return a note if so."""
    try:
        if (yield from access.read_optional(full.entries[-1])) is not None:
            yield from _map_pdo(access, node, full)
            return []
    except DriveRefusalError:
        # The entry cannot be mapped; any other error recurs in the next attempt.
        pass
    yield from _map_pdo(access, node, without)
    return [missing]


def _map_pdo(access: ObjectAccess, node: int, pdo: Pdo) -> Procedure[None]:
    """Map a PDO in the order of CiA 301: off, transmission type, mapping, on."""
    cob_id, count = _cob_id(pdo.communication), od.Entry(pdo.mapping, 0, od.U8, "mapped entries")
    address = pdo.function_code + node
    try:
        before = yield from access.read(cob_id)
    except DriveRefusalError:
        before = address
    # The address may change only while the PDO is off. The bit for remote frames must stay.
    yield from access.write(cob_id, od.PDO_OFF | before)
    yield from _write_transmission(access, pdo)
    if pdo.communication >= _FIRST_TRANSMIT_PDO:
        # Send at once after a SYNC, and only then.
        for subindex, name in ((3, "inhibit time"), (5, "event timer")):
            entry = od.Entry(pdo.communication, subindex, od.U16, name)
            yield from access.write_optional(entry, 0)
    yield from access.write(count, 0)
    for number, entry in enumerate(pdo.entries, start=1):
        yield from access.write(
            od.Entry(pdo.mapping, number, od.U32, f"mapping of {entry}"), entry.mapping
        )
    yield from access.write(count, len(pdo.entries))
    yield from access.write(cob_id, before & od.PDO_NO_REMOTE | address)


def _switch_off_unused_pdos(access: ObjectAccess) -> Procedure[None]:
    """Switch off the other transmit PDOs, which may send on each change and load the bus."""
    for communication in _UNUSED_PDOS:
        cob_id = _cob_id(communication)
        before = yield from access.read_optional(cob_id)
        if before is not None and not before & od.PDO_OFF:
            yield from access.write_optional(cob_id, od.PDO_OFF | before)


def _cob_id(communication: int) -> od.Entry:
    return od.Entry(communication, 1, od.U32, "COB-ID")


def _write_transmission(access: ObjectAccess, pdo: Pdo) -> Procedure[None]:
    transmission = od.Entry(pdo.communication, 2, od.U8, "transmission type")
    types = [pdo.transmission]
    if pdo.communication < _FIRST_TRANSMIT_PDO:
        # A received PDO may also take effect at once: all PDOs of a cycle are sent together.
        types += [od.ASYNCHRONOUS, od.ASYNCHRONOUS_BY_MANUFACTURER]
    yield from _first_accepted(access.write(transmission, number) for number in types)


def _first_accepted(attempts: Iterable[Procedure[None]]) -> Procedure[None]:
    """Run procedures until the drive accepts one; raise the first refusal if it accepts none."""
    refusals = []
    for attempt in attempts:
        try:
            yield from attempt
        except DriveRefusalError as error:
            refusals.append(error)
        else:
            return
    raise refusals[0]
