"""The link between handlers: what it makes of what comes off the bus."""

from __future__ import annotations

import itertools

import pytest

from needle_core.can_frame import CanErrors, CanFrame
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.link_settings import LinkSettings
from needle_device_driver.link.object_access import DriveError, ObjectAccess
from needle_device_driver.link.objects import DEVICE_TYPE
from needle_device_driver.procedure import run


@pytest.fixture
def link() -> FrameLink:
    link = FrameLink(LinkSettings("virtual", "test"))
    link.open()
    return link


def test_errors_are_counted_and_refusals_named_where_nobody_answers(link: FrameLink) -> None:
    link.receive([CanErrors(2), CanErrors(0, 1)])
    assert link.error_frames == 3
    with pytest.raises(DriveError, match=r"does not answer.*the adapter refuses"):
        run(ObjectAccess(link, 1).read(DEVICE_TYPE), lambda *_: None, itertools.count().__next__)


def test_a_frame_is_as_old_as_its_port_says(link: FrameLink) -> None:
    heard: list[tuple[bytes, float]] = []
    link.subscribe(0x181, lambda data, time: heard.append((data, time)))
    link.now = 2.0
    frames = [CanFrame(0x181, b"\x01", time=1.5), CanFrame(0x181, b"\x02"), CanFrame(0x182)]
    link.receive([*frames, CanFrame(0x181, remote=True)])
    assert heard == [(b"\x01", 1.5), (b"\x02", 2.0)]
