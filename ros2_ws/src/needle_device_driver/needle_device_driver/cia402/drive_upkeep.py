"""Procedures before and after the set-up of a drive: identity, start, watchdog, fault reset."""

from __future__ import annotations

from collections.abc import Iterable

from needle_device_driver.axes.link import DriveError
from needle_device_driver.cia402.cia402 import FAULTS, POWERED, DriveCommand, Mode, drive_state
from needle_device_driver.cia402.drive_monitor import DriveMonitor
from needle_device_driver.cia402.drive_settings import DriveSettings
from needle_device_driver.link import objects as od
from needle_device_driver.link.error_codes import describe_error
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.object_access import ObjectAccess
from needle_device_driver.link.sdo_client import SdoAbortedError, SdoTimeoutError
from needle_device_driver.procedure import Procedure, Wait

# Time-outs [s].
_HEARTBEAT_TIMEOUT = 0.3
_START_TIMEOUT = 1.0
_FAULT_RESET_TIMEOUT = 1.0

_DEVICE_NAME = 0x1008
# Prefix of the device names of needle_sim's drive_emulator, which moves no motor.
_EMULATED = b"Emulated "


class StuckFaultError(DriveError):
    """A drive does not leave its fault."""


def are_emulated(link: FrameLink, nodes: Iterable[int]) -> Procedure[bool]:
    """Return whether each drive reports that it is emulated; otherwise it counts as real.

    Parameters
    ----------
    link : FrameLink
        The bus, open.
    nodes : iterable of int
        Node ids of the drives.

    Raises
    ------
    LinkError
        If the link is lost.
    """
    for node in nodes:
        link.beat()
        try:
            name = yield from link.sdo_client(node).upload(_DEVICE_NAME, 0)
        except (SdoAbortedError, SdoTimeoutError):
            return False
        if not name.startswith(_EMULATED):
            return False
    return True


def await_operational(
    link: FrameLink, monitor: DriveMonitor, period: float, timeout: float = _HEARTBEAT_TIMEOUT
) -> Procedure[bool]:
    """Return whether the drive reports operational; meanwhile send the computer's heartbeat."""
    until = link.now + timeout
    while link.now < until:
        # Count first: the drive may answer at once.
        before = monitor.heartbeats
        link.beat()
        yield Wait(lambda: monitor.heartbeats > before, period)  # noqa: B023 - runs in this pass
        if monitor.heartbeats > before and monitor.nmt_state == od.NMT_OPERATIONAL:
            return True
    return False


def await_start(
    link: FrameLink, monitor: DriveMonitor, settings: DriveSettings, period: float
) -> Procedure[None]:
    """Wait until a drive that was set up is operational.

    Raises
    ------
    DriveError
        If it does not become operational, or sends no heartbeat.
    LinkError
        If the link is lost.
    """
    if not (yield from await_operational(link, monitor, period, _START_TIMEOUT)):
        what = "did not become operational" if monitor.heartbeats else "sends no heartbeat (0x1017)"
        raise DriveError(f"node {settings.node_id} {what}")


def arm_watchdog(link: FrameLink, settings: DriveSettings, watchdog: float) -> Procedure[None]:
    """Arm the drive's stop after `watchdog` [s] without a heartbeat; raises as `set_up`.

    It is the last step of a set-up: from here on the loop must send its heartbeat.
    """
    if settings.actuated:
        yield from ObjectAccess(link, settings.node_id).write_checked(
            od.CONSUMER_HEARTBEAT, od.MASTER_NODE_ID << 16 | round(watchdog * 1e3)
        )


def disarm_watchdog(link: FrameLink, settings: DriveSettings) -> Procedure[None]:
    """Switch the drive's watchdog off before shutting down; raises as `set_up`."""
    if settings.actuated:
        yield from ObjectAccess(link, settings.node_id).write(od.CONSUMER_HEARTBEAT, 0)


def reset_fault(link: FrameLink, settings: DriveSettings) -> Procedure[None]:
    """Acknowledge a drive's fault and wait until it clears; moves nothing.

    The controlword is sent by PDO, because many operational drives reject it by SDO.

    Parameters
    ----------
    link : FrameLink
        The bus, open.
    settings : DriveSettings
        The drive.

    Raises
    ------
    StuckFaultError
        If the drive stays in its fault.
    DriveError
        If it does not answer, or still has power because it is stopping.
    LinkError
        If the link is lost.
    """
    access = ObjectAccess(link, settings.node_id)

    def command(word: DriveCommand) -> Procedure[None]:
        if settings.actuated:
            data = od.COMMAND.pack(word, Mode.CYCLIC_SYNCHRONOUS_POSITION)
            link.send(od.COMMAND.function_code + settings.node_id, data)
        else:
            yield from access.write(od.CONTROLWORD, word)

    state = drive_state((yield from access.read(od.STATUSWORD)))
    if settings.actuated and state in POWERED:
        raise DriveError("is still stopping: reset again after it stops")
    if state not in FAULTS:
        return
    # A rising edge of the bit acknowledges the fault.
    yield from command(DriveCommand.DISABLE_VOLTAGE)
    yield from command(DriveCommand.FAULT_RESET)
    until = link.now + _FAULT_RESET_TIMEOUT
    while drive_state((yield from access.read(od.STATUSWORD))) in FAULTS:
        if link.now > until:
            code = yield from access.read_optional(od.ERROR_CODE)
            why = "" if code is None else f": {describe_error(code)}"
            raise StuckFaultError(f"the drive does not leave its fault{why}")
    yield from command(DriveCommand.DISABLE_VOLTAGE)
