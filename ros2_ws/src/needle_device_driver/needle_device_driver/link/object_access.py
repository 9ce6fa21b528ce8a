"""Read and write access to a drive's object dictionary by SDO."""

from __future__ import annotations

import contextlib

from needle_device_driver.axes.link import DriveError
from needle_device_driver.link.error_codes import NO_SUCH_OBJECT, WRONG_LENGTH
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.objects import Entry
from needle_device_driver.link.sdo_client import SdoAbortedError, SdoClient, SdoTimeoutError
from needle_device_driver.procedure import Procedure


class ObjectError(DriveError):
    """An entry of a drive does not meet the driver's requirements.

    Parameters
    ----------
    text : str
        The entry and the reason.
    entry : Entry
        The entry.
    """

    def __init__(self, text: str, entry: Entry) -> None:
        super().__init__(text)
        self.entry = entry


class DriveRefusalError(ObjectError):
    """A drive refuses to read or write an entry.

    Parameters
    ----------
    text : str
        The entry and the reason.
    entry : Entry
        The entry.
    code : int
        SDO abort code.
    """

    def __init__(self, text: str, entry: Entry, code: int) -> None:
        super().__init__(text, entry)
        self.code = code

    @property
    def object_is_missing(self) -> bool:
        """Whether the drive does not have the entry."""
        return self.code in NO_SUCH_OBJECT


class ObjectAccess:
    """Reads and writes entries of one node; each transfer is a procedure.

    Parameters
    ----------
    link : FrameLink
        The bus, open.
    node_id : int
        The node.
    """

    def __init__(self, link: FrameLink, node_id: int) -> None:
        self._link = link
        self._node_id = node_id

    def read(self, entry: Entry) -> Procedure[int]:
        """Return the value of an entry.

        Raises
        ------
        DriveRefusalError
            If the drive does not have it.
        DriveError
            If the drive does not answer.
        LinkError
            If the link is lost.
        """
        try:
            data = yield from self._begin().upload(entry.index, entry.subindex)
            narrower = entry.resized(len(data)) if len(data) < entry.size else None
            return (narrower or entry).unpack(data)
        except (SdoAbortedError, SdoTimeoutError, ValueError) as error:
            raise self._error("read", entry, error) from error

    def read_optional(self, entry: Entry) -> Procedure[int | None]:
        """Return the value of an entry, None if the drive refuses; otherwise raises as `read`."""
        try:
            return (yield from self.read(entry))
        except DriveRefusalError:
            return None

    def write(self, entry: Entry, value: int, *, variable: bool = False) -> Procedure[None]:
        """Write an entry; raises as `read`.

        If the entry's size in the drive differs from the standard, the drive's size is used. A
        refusal is not an error if the entry already has the value, unless the entry is `variable`,
        that is, gets other values later.
        """
        try:
            yield from self._begin().download(entry.index, entry.subindex, entry.pack(value))
        except SdoAbortedError as error:
            if error.code in WRONG_LENGTH and (yield from self._write_resized(entry, value)):
                return
            if variable or not (yield from self._has_value(entry, value)):
                raise self._error(f"write {value} to", entry, error) from error
        except SdoTimeoutError as error:
            raise self._error(f"write {value} to", entry, error) from error

    def write_checked(
        self,
        entry: Entry,
        value: int,
        *,
        accepted: tuple[int, int] | None = None,
        variable: bool = False,
    ) -> Procedure[None]:
        """Write an entry that a safety rule depends on, and read it back; raises as `read`.

        Parameters
        ----------
        entry : Entry
            The entry.
        value : int
            New value of the entry.
        accepted : tuple of int, optional
            Least and greatest accepted value after rounding by the drive; by default `value`.
        variable : bool
            As in `write`.

        Raises
        ------
        DriveError
            Also if the entry then has another value.
        """
        yield from self.write(entry, value, variable=variable)
        got = yield from self.read(entry)
        lower, upper = accepted or (value, value)
        if not lower <= got <= upper:
            raise DriveError(
                f"node {self._node_id} was set to {value} at {entry} but reads back {got}"
            )

    def write_optional(self, entry: Entry, value: int) -> Procedure[None]:
        """Write an entry; a refusal is ignored."""
        with contextlib.suppress(DriveRefusalError):
            yield from self.write(entry, value)

    def _begin(self) -> SdoClient:
        """Send the computer's heartbeat before a transfer; return the node's client."""
        self._link.beat()
        return self._link.sdo_client(self._node_id)

    def _write_resized(self, entry: Entry, value: int) -> Procedure[bool]:
        try:
            data = yield from self._begin().upload(entry.index, entry.subindex)
            resized = entry.resized(len(data))
            if resized is None:
                return False
            data = resized.pack(value)
            yield from self._begin().download(entry.index, entry.subindex, data)
        except (SdoAbortedError, SdoTimeoutError):
            return False
        return True

    def _has_value(self, entry: Entry, value: int) -> Procedure[bool]:
        try:
            return (yield from self.read(entry)) == value
        except DriveError:
            return False

    def _error(self, action: str, entry: Entry, error: Exception) -> DriveError:
        if isinstance(error, SdoAbortedError):
            return DriveRefusalError(
                f"node {self._node_id} refuses to {action} {entry}: {error} (see docs/hardware.md)",
                entry,
                error.code,
            )
        if isinstance(error, ValueError):
            return DriveError(f"node {self._node_id} sends {error}")
        hint = (
            "; the adapter rejects commands: check bitrate and wiring" if self._link.refused else ""
        )
        return DriveError(f"node {self._node_id} does not answer ({action} {entry}){hint}")
