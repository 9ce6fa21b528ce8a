"""Identity of emulated drives."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from needle_device_driver.cia402.drive_upkeep import are_emulated
from needle_device_driver.link.sdo_client import SdoAbortedError, SdoTimeoutError
from needle_device_driver.procedure import Procedure, run_at_once


class Named:
    """A node that reports its name, refuses to, or does not answer."""

    def __init__(self, name: bytes | Exception) -> None:
        self.name = name

    def upload(self, index: int, _: int) -> Procedure[bytes]:
        yield from ()
        assert index == 0x1008
        if isinstance(self.name, Exception):
            raise self.name
        return self.name


@pytest.mark.parametrize(
    ("second", "emulated"),
    [
        (b"Emulated rotation drive", True),
        (b"EL7041", False),
        (SdoAbortedError(0x0602_0000), False),
        (SdoTimeoutError(), False),
    ],
)
def test_drives_count_as_real_unless_all_report_emulated(
    second: bytes | Exception, emulated: bool
) -> None:
    nodes = {1: Named(b"Emulated insertion drive"), 2: Named(second)}
    bus: Any = SimpleNamespace(beat=lambda: None, sdo_client=nodes.__getitem__)
    assert run_at_once(are_emulated(bus, nodes)) is emulated
