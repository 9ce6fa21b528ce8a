"""A drive's object dictionary, read and written by SDO."""

from __future__ import annotations

import contextlib

from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.objects import Entry
from needle_device_driver.link.sdo_aborts import (
    NO_SUCH_OBJECT,
    OTHER_LENGTH,
    SdoAbortedError,
    SdoSilenceError,
)
from needle_device_driver.procedure import Procedure


class DriveError(Exception):
    """A drive does not answer, or refuses; the text says what and why."""


class DriveRefusalError(DriveError):
    """A drive refuses to have an entry read or written.

    Parameters
    ----------
    text : str
        What and why.
    code : int
        SDO abort code.
    """

    def __init__(self, text: str, code: int) -> None:
        super().__init__(text)
        self.code = code

    @property
    def object_is_missing(self) -> bool:
        """Tell whether the drive does not have the entry at all."""
        return self.code in NO_SUCH_OBJECT


class ObjectAccess:
    """Reads and writes entries of one node; each transfer is a procedure that awaits its answer.

    Before each transfer, and while it waits, the computer's heartbeat goes out, so that the
    watchdog of the other drive does not trip while one is set up.

    Parameters
    ----------
    link : FrameLink
        The bus, open.
    node_id : int
        Which node.
    """

    def __init__(self, link: FrameLink, node_id: int) -> None:
        self._link = link
        self._node_id = node_id

    def read(self, entry: Entry) -> Procedure[int]:
        """Return an entry's value.

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
            data = yield from self._upload(entry)
            narrower = entry.resized(len(data)) if len(data) < entry.size else None
            return (narrower or entry).unpack(data)
        except (SdoAbortedError, SdoSilenceError, ValueError) as error:
            raise self._error("read", entry, error) from error

    def ask(self, entry: Entry) -> Procedure[int | None]:
        """Return an entry's value, None if the drive refuses to tell it; else raises as `read`."""
        try:
            return (yield from self.read(entry))
        except DriveRefusalError:
            return None

    def write(self, entry: Entry, value: int, *, variable: bool = False) -> Procedure[None]:
        """Write an entry; raises as `read`.

        A drive in which it is wider or narrower than the standard has it gets it as wide as it has
        it. A drive that refuses to be given what it has already has not refused, unless the entry
        is `variable`: it will be given other values later.
        """
        try:
            yield from self._download(entry, entry.pack(value))
        except SdoAbortedError as error:
            if error.code in OTHER_LENGTH and (yield from self._write_resized(entry, value)):
                return
            if variable or not (yield from self._holds(entry, value)):
                raise self._error(f"write {value} to", entry, error) from error
        except SdoSilenceError as error:
            raise self._error(f"write {value} to", entry, error) from error

    def write_checked(
        self,
        entry: Entry,
        value: int,
        *,
        taken: tuple[int, int] | None = None,
        variable: bool = False,
    ) -> Procedure[None]:
        """Write an entry that a safety rule depends on, and read it back; raises as `read`.

        Parameters
        ----------
        entry : Entry
            Where.
        value : int
            What it shall be.
        taken : tuple of int, optional
            The least and the most that a drive which rounds may make of it; otherwise nothing else.
        variable : bool
            As `write` has it.

        Raises
        ------
        DriveError
            Also if the drive has something else then.
        """
        yield from self.write(entry, value, variable=variable)
        got = yield from self.read(entry)
        lower, upper = taken or (value, value)
        if not lower <= got <= upper:
            raise DriveError(f"node {self._node_id} took {value} for {entry} and has {got}")

    def offer(self, entry: Entry, value: int) -> Procedure[None]:
        """Write an entry that is good to have; a drive that refuses goes without."""
        with contextlib.suppress(DriveRefusalError):
            yield from self.write(entry, value)

    def _upload(self, entry: Entry) -> Procedure[bytes]:
        self._link.beat()
        return (yield from self._link.sdo(self._node_id).upload(entry.index, entry.subindex))

    def _download(self, entry: Entry, data: bytes) -> Procedure[None]:
        self._link.beat()
        client = self._link.sdo(self._node_id)
        yield from client.download(entry.index, entry.subindex, data)

    def _write_resized(self, entry: Entry, value: int) -> Procedure[bool]:
        try:
            resized = entry.resized(len((yield from self._upload(entry))))
            if resized is None:
                return False
            yield from self._download(resized, resized.pack(value))
        except (SdoAbortedError, SdoSilenceError):
            return False
        return True

    def _holds(self, entry: Entry, value: int) -> Procedure[bool]:
        try:
            return (yield from self.read(entry)) == value
        except DriveError:
            return False

    def _error(self, what: str, entry: Entry, error: Exception) -> DriveError:
        if isinstance(error, SdoAbortedError):
            return DriveRefusalError(
                f"node {self._node_id} refuses to {what} {entry}: {error} "
                "(docs/hardware.md says what for)",
                error.code,
            )
        if isinstance(error, ValueError):
            return DriveError(f"node {self._node_id} sends {error}")
        why = (
            "; the adapter refuses what it is told: bitrate, wiring?" if self._link.refused else ""
        )
        return DriveError(f"node {self._node_id} does not answer ({what} {entry}){why}")
