"""A protocol of polled drives, and the other end of its connection."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

from needle_device_driver.parameters import AXES, DeviceDriverParameters
from needle_device_driver.polled.drive_protocol import DriveProtocol, DriveReply
from needle_device_driver.polled.text_link import TextLink
from needle_device_driver.procedure import Procedure, T, run

P = TypeVar("P", bound=DriveProtocol)


class ProtocolBench(Generic[P]):
    """Runs the procedures of a protocol, and records the states that it reports."""

    def __init__(self, kind: type[P], **parameters: Any) -> None:
        settings = DeviceDriverParameters(**parameters)
        self.link = TextLink("test", kind.terminators)
        self.link.open()
        self.protocol = kind(settings, {axis: settings.axis(axis) for axis in AXES}, self.link)
        self.states: list[tuple[int, dict[str, DriveReply]]] = []
        self.protocol.on_status = lambda number, at: self.states.append((number, dict(at)))

    def sent(self) -> bytes:
        """Return the bytes sent since the last call."""
        return b"".join(self.link.pop_outgoing())

    def receive(self, *chunks: bytes) -> None:
        for line in self.link.receive(chunks):
            self.protocol.on_line(line)

    def reply(self, sent: bytes) -> None:
        """Reply to the commands that a procedure has sent."""

    def run(self, procedure: Procedure[T]) -> T:
        def wait(is_there: Callable[[], bool], seconds: float) -> None:
            self.reply(self.sent())
            self.link.now += 0.0 if is_there() else seconds

        return run(procedure, wait, lambda: self.link.now)

    def set_up(self) -> None:
        for axis in AXES:
            self.run(self.protocol.set_up(axis))

    def state(self, axis: str = "insertion") -> DriveReply:
        """Return the last reported state of an axis."""
        return self.states[-1][1][axis]
