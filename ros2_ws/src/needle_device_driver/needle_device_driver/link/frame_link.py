"""A CAN bus as drives are steered through it, whatever carries the frames."""

from __future__ import annotations

import abc
import threading
from collections.abc import Callable

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


class FrameLink(abc.ABC):
    """One CAN bus, to be opened, lost and opened again. All sending is the control loop's.

    Parameters
    ----------
    settings : LinkSettings
        Which adapter.
    clock : callable
        Steady time [s].

    Attributes
    ----------
    arrival : threading.Condition
        Notified of each frame; who reads what frames change holds its lock.
    lost : str
        How the link was lost; empty: it is not.
    other_master : str
        What another master was heard to send; empty: nobody's.
    """

    def __init__(self, settings: LinkSettings, clock: Callable[[], float]) -> None:
        self.settings = settings
        self.clock = clock
        self.arrival = threading.Condition()
        self.lost = ""
        self.other_master = ""
        self.openings = 0
        self.frames_sent = 0
        self.frames_received = 0
        self.error_frames = 0
        self._callbacks: dict[int, list[Callback]] = {}
        self._sdo: dict[int, SdoClient] = {}

    @property
    @abc.abstractmethod
    def is_open(self) -> bool:
        """Tell whether the link is open, as far as anybody knows."""

    @property
    def errors(self) -> int:
        """Number of error frames, and of process data that are none."""
        return self.error_frames

    @property
    def refused(self) -> int:
        """Number of commands and frames that the adapter did not take."""
        return 0

    @abc.abstractmethod
    def open(self) -> None:
        """Open the link; one that is lost is opened anew.

        Raises
        ------
        LinkError
            If that is not possible.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Let go of the bus. May be called twice."""

    @abc.abstractmethod
    def send(self, cob_id: int, data: bytes = b"") -> None:
        """Send one frame.

        Raises
        ------
        LinkError
            If the link is closed or lost.
        """

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

    def _note_opening(self) -> None:
        """Begin anew: what was asked before is not answered any more."""
        self._sdo = {}
        self.lost = self.other_master = ""
        self.openings += 1

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
        with self.arrival:
            self.arrival.notify_all()
