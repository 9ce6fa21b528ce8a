"""CAN bus of the drives: components pass its frames in batches."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from needle_core.can_frame import CanErrors, CanFrame
from needle_device_driver.axes.link import Link
from needle_device_driver.link.objects import (
    HEARTBEAT,
    MASTER_NODE_ID,
    NMT,
    NMT_OPERATIONAL,
    SDO_RESPONSE,
    SYNC,
)
from needle_device_driver.link.sdo_client import SdoClient

_HEARTBEAT_PERIOD = 0.02

# Frames that only a master sends. An adapter does not echo our own.
_MASTER_FRAMES = {
    NMT: "NMT commands",
    SYNC: "SYNC",
    HEARTBEAT + MASTER_NODE_ID: f"the heartbeat of node {MASTER_NODE_ID}, the computer's own",
}

Callback = Callable[[bytes, float], None]


class FrameLink(Link):
    """One CAN bus.

    Parameters
    ----------
    name : str
        Name of the link in messages.

    Attributes
    ----------
    other_master : str
        Frame of another master on the bus; empty: there is none.
    frames_sent, frames_received, bus_errors : int
        Counters.
    refused : int
        Number of commands and frames that the adapter refused.
    """

    _counters = ("frames_sent", "frames_received", "bus_errors")

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.other_master = ""
        self.frames_sent = 0
        self.frames_received = 0
        self.bus_errors = 0
        self.refused = 0
        self._outgoing: list[CanFrame] = []
        self._callbacks: dict[int, list[Callback]] = {}
        self._sdo_clients: dict[int, SdoClient] = {}

    def send(self, cob_id: int, data: bytes = b"") -> None:
        """Add one frame to the outgoing batch of the running handler.

        Raises
        ------
        LinkError
            If the link is closed or lost.
        """
        self._require_open()
        self._outgoing.append(CanFrame(cob_id, data))
        self.frames_sent += 1

    def pop_outgoing(self) -> tuple[CanFrame, ...]:
        """Return the frames that were sent since the last call."""
        frames = tuple(self._outgoing)
        self._outgoing.clear()
        return frames

    def receive(self, items: Iterable[CanFrame | CanErrors]) -> None:
        """Receive frames and error counts from the port."""
        for item in items:
            if isinstance(item, CanErrors):
                self.bus_errors += item.frames + item.refusals
                self.refused += item.refusals
            elif self.is_open and not item.remote:
                time = self.now if item.time is None else item.time
                self._receive_frame(item.identifier, item.data, time)

    def subscribe(self, cob_id: int, callback: Callback) -> None:
        """Call `callback(data, time)` for each frame with this COB-ID, as it arrives."""
        self._callbacks.setdefault(cob_id, []).append(callback)

    def beat(self) -> None:
        """Send the computer's heartbeat, which the drives' watchdogs need.

        Only the control loop may call this: the heartbeat proves that the loop runs.

        Raises
        ------
        LinkError
            If the link is closed or lost.
        """
        self.send(HEARTBEAT + MASTER_NODE_ID, bytes([NMT_OPERATIONAL]))

    def sdo_client(self, node_id: int) -> SdoClient:
        """Return the SDO client of a node; it is replaced when the link is reopened.

        Raises
        ------
        LinkError
            If the link is closed or lost.
        """
        self._require_open()
        if node_id not in self._sdo_clients:
            self._sdo_clients[node_id] = SdoClient(node_id, self.send, self.beat, _HEARTBEAT_PERIOD)
        return self._sdo_clients[node_id]

    def _restart(self) -> None:
        # Earlier requests get no response.
        self._sdo_clients = {}
        self.other_master = ""

    def _receive_frame(self, cob_id: int, data: bytes, time: float) -> None:
        self.frames_received += 1
        if cob_id in _MASTER_FRAMES:
            self.other_master = f"another master is on the bus: it sends {_MASTER_FRAMES[cob_id]}"
        for callback in self._callbacks.get(cob_id, ()):
            callback(data, time)
        client = self._sdo_clients.get(cob_id - SDO_RESPONSE)
        if client is not None:
            client.receive(data)
