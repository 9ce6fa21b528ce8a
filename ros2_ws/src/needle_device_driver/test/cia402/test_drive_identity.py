"""What a drive says that it is."""

from __future__ import annotations

from typing import Any, cast

import pytest

from needle_device_driver.cia402.drive_identity import are_emulated
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.sdo_aborts import SdoAbortedError, SdoSilenceError
from needle_device_driver.procedure import Procedure, Wait, run


class Named:
    """A bus on which each node has a name, or refuses to say it, or is not there."""

    def __init__(self, names: dict[int, bytes | Exception]) -> None:
        self._names = names
        self._node = 0

    def beat(self) -> None:
        """Be a link."""

    def sdo(self, node: int) -> Any:
        self._node = node
        return self

    def upload(self, index: int, subindex: int) -> Procedure[bytes]:
        yield Wait(lambda: True, 0.0)
        assert (index, subindex) == (0x1008, 0)
        name = self._names[self._node]
        if isinstance(name, Exception):
            raise name
        return name


@pytest.mark.parametrize(
    ("second", "emulated"),
    [
        (b"Emulated rotation drive", True),
        (b"EL7041", False),
        (b"", False),
        (SdoAbortedError(0x0602_0000), False),
        (SdoSilenceError(), False),
    ],
)
def test_one_drive_that_does_not_say_emulated_is_real(
    second: bytes | Exception, emulated: bool
) -> None:
    link = cast(FrameLink, Named({1: b"Emulated insertion drive", 2: second}))
    for nodes in ((1, 2), (2, 1)):
        told = run(are_emulated(link, nodes), lambda until, _: until(), lambda: 0.0)
        assert told is emulated
