"""Upkeep of a drive around its set-up: started, watched over, its fault acknowledged."""

from __future__ import annotations

from needle_device_driver.cia402.cia402 import FAULTS, POWERED, DriveCommand, Mode, drive_state
from needle_device_driver.cia402.drive_monitor import DriveMonitor
from needle_device_driver.cia402.drive_settings import DriveSettings
from needle_device_driver.link import objects as od
from needle_device_driver.link.emergency import describe_error
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.object_access import DriveError, ObjectAccess
from needle_device_driver.procedure import Procedure

# In seconds.
_HEARTBEAT_WAIT = 0.3
_START_WAIT = 1.0
_FAULT_RESET_WAIT = 1.0


class StuckFaultError(DriveError):
    """A drive does not leave its fault."""


def await_operational(
    link: FrameLink, monitor: DriveMonitor, period: float, timeout: float = _HEARTBEAT_WAIT
) -> Procedure[bool]:
    """Return whether the drive's heartbeat says: operational; the computer's goes on meanwhile."""
    until = link.now + timeout
    while link.now < until:
        # It may come at once.
        before = monitor.heartbeats
        link.beat()
        if (yield from monitor.await_operational(before, period)):
            return True
    return False


def await_start(
    link: FrameLink, monitor: DriveMonitor, settings: DriveSettings, period: float
) -> Procedure[None]:
    """Wait until a drive that was set up exchanges process data.

    Raises
    ------
    DriveError
        If it does not, or has no heartbeat to say so.
    LinkError
        If the link is lost.
    """
    if not (yield from await_operational(link, monitor, period, _START_WAIT)):
        what = "did not become operational" if monitor.heartbeats else "sends no heartbeat (0x1017)"
        raise DriveError(f"node {settings.node_id} {what}")


def arm_watchdog(link: FrameLink, settings: DriveSettings, watchdog: float) -> Procedure[None]:
    """Let the drive stop without the computer's heartbeat for `watchdog` [s]; raises as `set_up`.

    It is the last step of a set-up: from here on the loop must send its heartbeat.
    """
    if settings.actuated:
        yield from ObjectAccess(link, settings.node_id).write_checked(
            od.CONSUMER_HEARTBEAT, od.MASTER_NODE_ID << 16 | round(watchdog * 1e3)
        )


def disarm_watchdog(link: FrameLink, settings: DriveSettings) -> Procedure[None]:
    """Let the drive go without the computer, which takes its leave; raises as `set_up`."""
    if settings.actuated:
        yield from ObjectAccess(link, settings.node_id).write(od.CONSUMER_HEARTBEAT, 0)


def reset_fault(link: FrameLink, settings: DriveSettings) -> Procedure[None]:
    """Acknowledge a drive's fault and wait until it is gone; moves nothing.

    The drive is operational: its controlword is the process data's, and many drives no longer take
    it by SDO then.

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
        If it does not answer, or still has power: it is stopping.
    LinkError
        If the link is lost.
    """
    access = ObjectAccess(link, settings.node_id)

    def order(command: DriveCommand) -> Procedure[None]:
        if settings.actuated:
            data = od.COMMAND.pack(command, Mode.CYCLIC_SYNCHRONOUS_POSITION)
            link.send(od.COMMAND.function_code + settings.node_id, data)
        else:
            yield from access.write(od.CONTROLWORD, command)

    state = drive_state((yield from access.read(od.STATUSWORD)))
    if settings.actuated and state in POWERED:
        raise DriveError("is still stopping: reset again when it stands")
    if state not in FAULTS:
        return
    # The rising edge counts.
    yield from order(DriveCommand.DISABLE_VOLTAGE)
    yield from order(DriveCommand.FAULT_RESET)
    until = link.now + _FAULT_RESET_WAIT
    while drive_state((yield from access.read(od.STATUSWORD))) in FAULTS:
        if link.now > until:
            code = yield from access.ask(od.ERROR_CODE)
            why = "" if code is None else f": {describe_error(code)}"
            raise StuckFaultError(f"the drive does not leave its fault{why}")
    yield from order(DriveCommand.DISABLE_VOLTAGE)
