"""A drive's object dictionary, read and written by SDO."""

from __future__ import annotations

import canopen

from needle_device_driver.can_link import CanLink
from needle_device_driver.objects import HEARTBEAT, MASTER_NODE_ID, NMT_OPERATIONAL, Entry

_NO_SUCH_OBJECT = (0x0602_0000, 0x0609_0011)


class DriveError(Exception):
    """A drive does not answer, or refuses; the text says what and why."""


def send_heartbeat(link: CanLink) -> None:
    """Tell the drives' watchdogs that the control loop runs; only the loop itself may."""
    link.send(HEARTBEAT + MASTER_NODE_ID, bytes([NMT_OPERATIONAL]))


class ObjectAccess:
    """Reads and writes entries of one node; each transfer waits for its answer.

    Before each transfer the computer's heartbeat goes out, so that the watchdog of the other
    drive does not trip while one is set up.

    Parameters
    ----------
    link : CanLink
        The bus, open.
    node_id : int
        Which node.
    """

    def __init__(self, link: CanLink, node_id: int) -> None:
        self._link = link
        self._node_id = node_id

    def read(self, entry: Entry) -> int:
        """Return an entry's value.

        Raises
        ------
        DriveError
            If the drive does not answer or does not have it.
        LinkError
            If the link is lost.
        """
        send_heartbeat(self._link)
        try:
            return entry.unpack(self._link.sdo(self._node_id).upload(entry.index, entry.subindex))
        except (canopen.SdoAbortedError, canopen.SdoCommunicationError, ValueError) as error:
            raise self._error("read", entry, error) from error

    def write(self, entry: Entry, value: int) -> None:
        """Write an entry; raises as `read`."""
        send_heartbeat(self._link)
        data = entry.pack(value)
        try:
            self._link.sdo(self._node_id).download(entry.index, entry.subindex, data)
        except (canopen.SdoAbortedError, canopen.SdoCommunicationError) as error:
            raise self._error(f"write {value} to", entry, error) from error

    def write_checked(self, entry: Entry, value: int) -> None:
        """Write an entry that a safety rule depends on, and read it back; raises as `read`.

        Raises
        ------
        DriveError
            Also if the drive has something else then.
        """
        self.write(entry, value)
        got = self.read(entry)
        if got != value:
            raise DriveError(f"node {self._node_id} took {value} for {entry} and has {got}")

    def write_optional(self, entry: Entry, value: int, *, checked: bool = False) -> bool:
        """Write an entry that not every drive has; return whether this one does.

        Raises as `write`, or `write_checked` where `checked`: many drives round a ramp.
        """
        try:
            (self.write_checked if checked else self.write)(entry, value)
        except DriveError as error:
            if _is_lacking(error):
                return False
            raise
        return True

    def has(self, entry: Entry) -> bool:
        """Return whether the drive has an entry; raises as `read`."""
        try:
            self.read(entry)
        except DriveError as error:
            if _is_lacking(error):
                return False
            raise
        return True

    def _error(self, what: str, entry: Entry, error: Exception) -> DriveError:
        if isinstance(error, canopen.SdoCommunicationError):
            return DriveError(f"node {self._node_id} does not answer ({what} {entry})")
        return DriveError(f"node {self._node_id} refuses to {what} {entry}: {error}")


def _is_lacking(error: DriveError) -> bool:
    cause = error.__cause__
    return isinstance(cause, canopen.SdoAbortedError) and cause.code in _NO_SUCH_OBJECT
