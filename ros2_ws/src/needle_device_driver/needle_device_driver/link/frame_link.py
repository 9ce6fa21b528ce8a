"""The CAN bus as drives are steered through it: frames come and go in batches, between handlers."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from needle_core.can_frame import CanErrors, CanFrame
from needle_device_driver.link.link_settings import LinkSettings
from needle_device_driver.link.objects import (
    HEARTBEAT,
    MASTER_NODE_ID,
    NMT,
    NMT_OPERATIONAL,
    SDO_ANSWER,
    SYNC,
)
from needle_device_driver.link.sdo_client import SdoClient

_HEARTBEAT_PERIOD = 0.02

# What only a master sends, whom an adapter does not let hear itself.
_OF_MASTERS = {
    NMT: "NMT commands",
    SYNC: "SYNC",
    HEARTBEAT + MASTER_NODE_ID: f"the heartbeat of node {MASTER_NODE_ID}, the computer's own",
}

Callback = Callable[[bytes, float], None]


class LinkError(Exception):
    """The link cannot be opened or is lost; the text says which and why."""


class FrameLink:
    """One CAN bus, to be opened, lost and opened again; whoever runs the component carries frames.

    What is lost stays lost until it is opened again, for the drives have missed something.

    Parameters
    ----------
    settings : LinkSettings
        Only their text counts.

    Attributes
    ----------
    now : float
        Steady time of the handler that runs [s].
    lost : str
        How the link was lost; empty: it is not.
    other_master : str
        What another master was heard to send; empty: nobody's.
    """

    def __init__(self, settings: LinkSettings) -> None:
        self.settings = settings
        self.now = 0.0
        self.lost = ""
        self.other_master = ""
        self.openings = 0
        self.frames_sent = 0
        self.frames_received = 0
        self.error_frames = 0
        self.refused = 0
        self._is_open = False
        self._why_not = ""
        self._sent: list[CanFrame] = []
        self._callbacks: dict[int, list[Callback]] = {}
        self._sdo: dict[int, SdoClient] = {}

    @property
    def is_open(self) -> bool:
        """Tell whether frames pass."""
        return self._is_open and not self.lost

    def open(self) -> None:
        """Let frames pass; a lost link begins anew.

        Raises
        ------
        LinkError
            If the port is not open.
        """
        if self.is_open:
            return
        if self._why_not:
            raise LinkError(f"cannot open {self.settings}: {self._why_not}")
        self._is_open = True
        # What was asked before is not answered any more.
        self._sdo = {}
        self.lost = self.other_master = ""
        self.openings += 1

    def change(self, why_not: str) -> None:
        """Take that the port is open, or why it is not."""
        self._why_not = why_not
        if why_not and self.is_open:
            self.lost = f"link {self.settings} is lost: {why_not}"

    def close(self) -> None:
        """Let no frame pass."""
        self._is_open = False

    def send(self, cob_id: int, data: bytes = b"") -> None:
        """Send one frame with the batch of the handler that runs.

        Raises
        ------
        LinkError
            If the link is closed or lost.
        """
        if not self.is_open:
            raise LinkError(self.lost or f"{self.settings} is not open")
        self._sent.append(CanFrame(cob_id, data))
        self.frames_sent += 1

    def take_sent(self) -> tuple[CanFrame, ...]:
        """Return the frames that were sent since the last call."""
        frames = tuple(self._sent)
        self._sent.clear()
        return frames

    def receive(self, items: Iterable[CanFrame | CanErrors]) -> None:
        """Take what comes off the bus."""
        for item in items:
            if isinstance(item, CanErrors):
                self.error_frames += item.frames + item.refusals
                self.refused += item.refusals
            elif self.is_open and not item.remote:
                time = self.now if item.time is None else item.time
                self._take(item.identifier, item.data, time)

    def subscribe(self, cob_id: int, callback: Callback) -> None:
        """Call `callback(data, time)` for each frame with this COB-ID, as it arrives."""
        self._callbacks.setdefault(cob_id, []).append(callback)

    def beat(self) -> None:
        """Tell the drives' watchdogs that the control loop runs; only the loop itself may.

        Raises
        ------
        LinkError
            If the link is closed or lost.
        """
        self.send(HEARTBEAT + MASTER_NODE_ID, bytes([NMT_OPERATIONAL]))

    def sdo(self, node_id: int) -> SdoClient:
        """Return the SDO client of a node, on the present opening of the link.

        Raises
        ------
        LinkError
            If the link is closed or lost.
        """
        if not self.is_open:
            raise LinkError(self.lost or f"{self.settings} is not open")
        if node_id not in self._sdo:
            self._sdo[node_id] = SdoClient(node_id, self.send, self.beat, _HEARTBEAT_PERIOD)
        return self._sdo[node_id]

    def _take(self, cob_id: int, data: bytes, time: float) -> None:
        """Hand a frame that arrived at `time` [s] to whom it concerns."""
        self.frames_received += 1
        if cob_id in _OF_MASTERS:
            self.other_master = f"another master is on the bus: it sends {_OF_MASTERS[cob_id]}"
        for callback in self._callbacks.get(cob_id, ()):
            callback(data, time)
        client = self._sdo.get(cob_id - SDO_ANSWER)
        if client is not None:
            client.receive(data)
