"""Set-up of a drive's process data objects over SDO."""

from __future__ import annotations

from needle_device_driver.link import objects as od
from needle_device_driver.link.object_access import DriveRefusalError, ObjectAccess
from needle_device_driver.link.objects import Pdo
from needle_device_driver.procedure import Procedure

# Of the four that CiA 402 drives have by default; they may be on, and tell every change.
_UNUSED = (0x1802, 0x1803)
_FIRST_TRANSMIT = 0x1800


def map_pdo(access: ObjectAccess, node: int, pdo: Pdo) -> Procedure[None]:
    """Set a PDO up in the order that CiA 301 wants: off, type, mapping, on.

    Parameters
    ----------
    access : ObjectAccess
        The drive, pre-operational.
    node : int
        Its node id.
    pdo : Pdo
        What it shall carry.

    Raises
    ------
    DriveError
        If the drive does not answer or refuses.
    LinkError
        If the link is lost.
    """
    cob_id, count = _cob_id(pdo.communication), od.Entry(pdo.mapping, 0, od.U8, "mapped entries")
    address = pdo.function_code + node
    try:
        before = yield from access.read(cob_id)
    except DriveRefusalError:
        before = address
    # Its address may change only while it is off. Where remote frames are not had, their bit stays.
    yield from access.write(cob_id, od.PDO_OFF | before)
    yield from _write_transmission(access, pdo)
    if pdo.communication >= _FIRST_TRANSMIT:
        # Neither held back after a SYNC nor sent without one.
        for subindex, name in ((3, "inhibit time"), (5, "event timer")):
            yield from access.offer(od.Entry(pdo.communication, subindex, od.U16, name), 0)
    yield from access.write(count, 0)
    for number, entry in enumerate(pdo.entries, start=1):
        yield from access.write(
            od.Entry(pdo.mapping, number, od.U32, f"mapping of {entry}"), entry.mapping
        )
    yield from access.write(count, len(pdo.entries))
    yield from access.write(cob_id, before & od.PDO_NO_REMOTE | address)


def silence_unused(access: ObjectAccess) -> Procedure[None]:
    """Switch the process data off that nobody asked for: it takes the bus; raises as `map_pdo`."""
    for communication in _UNUSED:
        cob_id = _cob_id(communication)
        try:
            before = yield from access.read(cob_id)
        except DriveRefusalError:
            continue
        if not before & od.PDO_OFF:
            yield from access.offer(cob_id, od.PDO_OFF | before)


def _cob_id(communication: int) -> od.Entry:
    return od.Entry(communication, 1, od.U32, "COB-ID")


def _write_transmission(access: ObjectAccess, pdo: Pdo) -> Procedure[None]:
    transmission = od.Entry(pdo.communication, 2, od.U8, "transmission type")
    types = [pdo.transmission]
    if pdo.communication < _FIRST_TRANSMIT:
        # What a drive receives it may take at once: all of a cycle is sent together.
        types += [od.ASYNCHRONOUS, od.ASYNCHRONOUS_BY_MAKER]
    refusals = []
    for number in types:
        try:
            yield from access.write(transmission, number)
        except DriveRefusalError as error:
            refusals.append(error)
        else:
            return
    raise refusals[0]
