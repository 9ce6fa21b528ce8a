"""The driver's CAN link to emulated drives: frames take their time, and may be lost."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import can

from needle_core.can_frame import CanFrame
from needle_device_driver.link.can_link import CanLink
from needle_device_driver.link.frame_link import LinkError
from needle_device_driver.link.link_settings import LinkSettings
from needle_sim.drives.emulated_bus import EmulatedBus
from needle_verification.soak.link_faults import LinkFaults, Way
from needle_verification.soak.virtual_world import VirtualProcess, VirtualWorld

# A frame's way, adapter included [ns], at least and at most.
_FRAME_NS = (150_000, 600_000)
# How often the drives look at their clocks [ns].
_POLL_NS = 5_000_000
TO_DRIVES, FROM_DRIVES = "can to the drives", "can from the drives"
LINKS = (TO_DRIVES, FROM_DRIVES)


class VirtualCan:
    """Both drives on their bus, and the adapters that are plugged into it.

    Parameters
    ----------
    world : VirtualWorld
        Its time and chance.
    bus : EmulatedBus
        The drives.
    faults : LinkFaults
        What happens to frames, on `LINKS`.

    Attributes
    ----------
    unplugged : bool
        Whether the adapter is gone.
    watchers : list of callable
        Called whenever somebody opens it.
    sent_watchers : list of callable
        Called with the identifier and the data of each frame that is sent to the drives.
    """

    def __init__(self, world: VirtualWorld, bus: EmulatedBus, faults: LinkFaults) -> None:
        self._world = world
        self._faults = faults
        self.bus = bus
        self.unplugged = False
        self.watchers: list[Callable[[], None]] = []
        self.sent_watchers: list[Callable[[int, bytes], None]] = []
        self._links: list[VirtualLink] = []
        self._last_ns = dict.fromkeys(LINKS, 0)
        self._ways: dict[tuple[str, str], Way] = {}
        self._poll()

    def plug_in(self, link: VirtualLink) -> None:
        """Let a link hear the bus."""
        self._links.append(link)
        for watch in self.watchers:
            watch()

    def unplug(self) -> None:
        """Take the adapter away from whoever has it open."""
        self.unplugged = True
        for link in self._links:
            link.lose()
        self._links.clear()

    def pull(self, link: VirtualLink) -> None:
        """Close a link."""
        if link in self._links:
            self._links.remove(link)

    def send(self, identifier: int, data: bytes) -> None:
        """Put a frame of the computer's on the bus."""
        for watch in self.sent_watchers:
            watch(identifier, data)
        for due_ns, arrived in self._arrivals(TO_DRIVES, identifier, data):
            frame = CanFrame(identifier, arrived)
            self._world.call_at(due_ns, partial(self._take, frame))

    def _take(self, frame: CanFrame) -> None:
        self.bus.receive(frame, self._world.steady)
        self._hand_on(self.bus.take_sent())

    def _poll(self) -> None:
        self._hand_on(self.bus.poll(self._world.steady))
        self._world.call_after(_POLL_NS, self._poll)

    def _hand_on(self, frames: list[CanFrame]) -> None:
        for frame in frames:
            for due_ns, arrived in self._arrivals(FROM_DRIVES, frame.identifier, frame.data):
                message = can.Message(
                    arbitration_id=frame.identifier, data=arrived, is_extended_id=False
                )
                self._world.call_at(due_ns, partial(self._arrive, message))

    def _arrive(self, message: can.Message) -> None:
        for link in tuple(self._links):
            link.hear(message)

    def _arrivals(self, link: str, identifier: int, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Yield when a frame that is sent now arrives [ns], and what arrives."""
        key = link, f"{identifier:X}"
        if key not in self._ways:
            self._ways[key] = Way(self._world, _FRAME_NS, *key)
        way = self._ways[key]
        for delivery in self._faults.deliveries(link, data, way):
            due_ns = self._world.steady_ns + way.takes_ns() + delivery.late_ns
            if not delivery.overtakes:
                # A bus keeps the order.
                due_ns = self._last_ns[link] = max(due_ns, self._last_ns[link])
            yield due_ns, delivery.data


class VirtualLink(CanLink):
    """The driver's own link, without a thread: frames come as events.

    Parameters
    ----------
    settings : LinkSettings
        The driver's; only their text counts.
    clock : callable
        Steady time [s].
    adapter : VirtualCan
        What is opened.
    process : VirtualProcess
        Whose link it is.
    """

    def __init__(
        self,
        settings: LinkSettings,
        clock: Callable[[], float],
        adapter: VirtualCan,
        process: VirtualProcess,
    ) -> None:
        super().__init__(settings, clock, self._open_adapter)
        self.arrival = _Arrival(process)
        self._adapter = adapter
        self._process = process

    def hear(self, message: can.Message) -> None:
        """Take a frame off the bus, in what is the receiving thread elsewhere."""
        self._process.do_concurrently(lambda: self._dispatch(message))

    def lose(self) -> None:
        """Take note that the adapter is gone."""
        self._lose(OSError(5, "Input/output error"))

    def _open_adapter(self, settings: LinkSettings) -> Any:
        if self._adapter.unplugged:
            raise LinkError(f"cannot open {settings}: No such file or directory")
        return _Opening(self._adapter, self, self._process)

    def _begin_to_receive(self, bus: can.BusABC) -> None:
        del bus
        self._adapter.plug_in(self)


class _Opening:
    """The part of python-can's bus that the link uses."""

    def __init__(self, adapter: VirtualCan, link: VirtualLink, process: VirtualProcess) -> None:
        self._adapter, self._link, self._process = adapter, link, process

    def send(self, message: can.Message) -> None:
        if self._process.alive:
            self._adapter.send(message.arbitration_id, bytes(message.data))

    def shutdown(self) -> None:
        self._adapter.pull(self._link)


class _Arrival(threading.Condition):
    """Waits in the world's time, while the others go on."""

    def __init__(self, process: VirtualProcess) -> None:
        super().__init__()
        self._process = process
        self._notified = False

    def notify_all(self) -> None:
        self._notified = True

    def wait_for(self, predicate: Callable[[], Any], timeout: float | None = None) -> Any:
        held = bool(predicate())

        def holds() -> bool:
            nonlocal held
            if self._notified:
                self._notified = False
                held = bool(predicate())
            return held

        return self._process.wait_for(holds, timeout)
