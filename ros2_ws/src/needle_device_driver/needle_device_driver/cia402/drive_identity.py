"""Identity of a drive, as it tells it."""

from __future__ import annotations

from collections.abc import Iterable

from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.sdo_aborts import SdoAbortedError, SdoSilenceError
from needle_device_driver.procedure import Procedure

_DEVICE_NAME = 0x1008
# What the name of each drive of needle_sim's drive_emulator begins with; no motor hangs on it.
_EMULATED = b"Emulated "


def are_emulated(link: FrameLink, nodes: Iterable[int]) -> Procedure[bool]:
    """Return whether each of these drives says that it is an emulation.

    A drive that does not say so is taken for real, also one that says nothing.

    Parameters
    ----------
    link : FrameLink
        The bus, open.
    nodes : iterable of int
        The drives' node ids.

    Raises
    ------
    LinkError
        If the link is lost.
    """
    for node in nodes:
        name = yield from _device_name(link, node)
        if not name.startswith(_EMULATED):
            return False
    return True


def _device_name(link: FrameLink, node: int) -> Procedure[bytes]:
    link.beat()
    try:
        return (yield from link.sdo(node).upload(_DEVICE_NAME, 0))
    except (SdoAbortedError, SdoSilenceError):
        return b""
