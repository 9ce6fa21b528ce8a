"""The source of image pairs as a component's port: a thread reads it, so that nobody else waits."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from needle_core.component import Batch, PortChange
from needle_core.errors import UserError
from needle_tracker.sources.stereo_source import EndOfRecording, StampedPair, StereoSource

Event = StampedPair | EndOfRecording | None
"""What a source gives when it is asked."""


class PairPort:
    """Asks the source for its next pair, whatever is sent; hands over what it gives.

    Parameters
    ----------
    source : StereoSource
        An open one, closed with the port.
    """

    def __init__(self, source: StereoSource) -> None:
        self._source = source
        self._reader = ThreadPoolExecutor(1, "pairs")

    def open(self, arrive: Callable[[Batch | PortChange], None]) -> None:
        """Begin; `arrive` is called by the thread."""
        self._arrive = arrive

    def send(self, batch: tuple[Any, ...]) -> None:
        """Ask for the next pair."""
        self._reader.submit(self._source.next).add_done_callback(self._on_read)

    def close(self) -> None:
        """Let go of the source, once it is not being read."""
        self._reader.shutdown()
        self._source.close()

    def _on_read(self, read: Future[Event]) -> None:
        error = read.exception()
        if isinstance(error, UserError):
            self._arrive(PortChange(str(error)))
        else:
            # A mistake of ours is raised where this is called, and ends the node.
            self._arrive(lambda: (read.result(),))
