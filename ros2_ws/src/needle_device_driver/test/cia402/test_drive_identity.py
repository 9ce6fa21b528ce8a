"""Identity of emulated drives."""

from __future__ import annotations

from typing import Any, cast

from needle_device_driver.cia402.drive_upkeep import are_emulated
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.sdo_client import SdoAbortedError, SdoTimeoutError
from needle_device_driver.procedure import Procedure, run_at_once


class Named:
    """A bus on which each node has a name, refuses to report it, or is missing."""

    def __init__(self, *names: bytes | Exception) -> None:
        self._names = names
        self.beats = 0

    def beat(self) -> None:
        self.beats += 1

    def sdo_client(self, node: int) -> Any:
        self._name = self._names[node - 1]
        return self

    def upload(self, index: int, subindex: int) -> Procedure[bytes]:
        yield from ()
        assert (index, subindex) == (0x1008, 0)
        if isinstance(self._name, Exception):
            raise self._name
        return self._name


def test_drives_count_as_real_unless_all_report_emulated() -> None:
    for second, emulated in (
        (b"Emulated rotation drive", True),
        (b"EL7041", False),
        (b"", False),
        (SdoAbortedError(0x0602_0000), False),
        (SdoTimeoutError(), False),
    ):
        for nodes in ((1, 2), (2, 1)):
            bus = Named(b"Emulated insertion drive", second)
            assert run_at_once(are_emulated(cast(FrameLink, bus), nodes)) is emulated
            assert bus.beats >= 1
