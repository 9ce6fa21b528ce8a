"""Identity of a drive, as it tells it."""

from __future__ import annotations

from collections.abc import Iterable

import canopen

from needle_device_driver.link.can_link import CanLink

_DEVICE_NAME = 0x1008
# What the name of each drive of needle_sim's drive_emulator begins with; no motor hangs on it.
_EMULATED = b"Emulated "


def are_emulated(link: CanLink, nodes: Iterable[int]) -> bool:
    """Return whether each of these drives says that it is an emulation.

    A drive that does not say so is taken for real, also one that says nothing.

    Parameters
    ----------
    link : CanLink
        The bus, open.
    nodes : iterable of int
        The drives' node ids.

    Raises
    ------
    LinkError
        If the link is lost.
    """
    return all(_device_name(link, node).startswith(_EMULATED) for node in nodes)


def _device_name(link: CanLink, node: int) -> bytes:
    link.beat()
    try:
        return bytes(link.sdo(node).upload(_DEVICE_NAME, 0))
    except (canopen.SdoAbortedError, canopen.SdoCommunicationError):
        return b""
