"""The recorder's writing half: a queue that callbacks append to, and a thread that empties it."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path

from needle_bringup.bag_writer import BagTopic, BagWriteError, BagWriter

FLUSH_PERIOD = 0.25


class Recording:
    """A bag that fills in a thread of its own, so that no disk delay reaches the subscriptions.

    Parameters
    ----------
    directory : Path
        The bag.
    distribution : str
        ROS distribution of its message types.

    Raises
    ------
    UserError
        If the directory holds a bag already or cannot be made.

    Attributes
    ----------
    error : str or None
        Why writing ended before its time; None while all is well.
    """

    def __init__(self, directory: Path, *, distribution: str = "jazzy") -> None:
        self._bag = BagWriter(directory, distribution=distribution)
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._channels: dict[str, int] = {}
        self.error: str | None = None
        self.bytes_received = 0
        self.messages_received = 0
        self._thread = threading.Thread(target=self._run, name="bag_writer")
        self._thread.start()

    @property
    def messages_waiting(self) -> int:
        """Messages received that the thread has not taken yet."""
        return self._jobs.qsize()

    def add_topic(self, topic: BagTopic) -> None:
        """Announce a topic; before the first `append` with its name."""
        self._jobs.put(lambda: self._add_topic(topic))

    def append(self, topic: str, data: bytes, log_time: int, publish_time: int) -> None:
        """Queue one serialised message; times are the system clock's [ns]."""
        self.bytes_received += len(data)
        self.messages_received += 1
        self._jobs.put(lambda: self._bag.write(self._channels[topic], data, log_time, publish_time))

    def add_record(self, name: str, values: dict[str, str]) -> None:
        """Queue a metadata record, kept in the MCAP file as soon as it is known."""
        self._jobs.put(lambda: self._bag.add_metadata(name, values))

    def add_file(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Queue a file that the bag carries."""
        self._jobs.put(lambda: self._bag.add_attachment(name, media_type, data, time_ns))

    def set_custom_data(self, key: str, value: str) -> None:
        """Queue a text for metadata.yaml's `custom_data`."""
        self._jobs.put(lambda: self._bag.set_custom_data(key, value))

    def close(self) -> None:
        """Write all that waits, then index and metadata; `error` tells how it went."""
        if self._thread.is_alive():
            self._jobs.put(None)
            self._thread.join()

    def _add_topic(self, topic: BagTopic) -> None:
        self._channels[topic.name] = self._bag.add_topic(topic)

    def _run(self) -> None:
        try:
            self._empty_queue()
            self._bag.close()
        except BagWriteError as error:
            self.error = str(error)
            self._bag.abandon()
            self._discard()

    def _empty_queue(self) -> None:
        next_flush = time.monotonic() + FLUSH_PERIOD
        while True:
            try:
                job = self._jobs.get(timeout=max(0.0, next_flush - time.monotonic()))
                if job is None:
                    return
                job()
            except queue.Empty:
                pass
            if time.monotonic() >= next_flush:
                self._bag.flush()
                next_flush = time.monotonic() + FLUSH_PERIOD

    def _discard(self) -> None:
        """Free what still arrives after an error, until the recorder closes."""
        while self._jobs.get() is not None:
            pass
