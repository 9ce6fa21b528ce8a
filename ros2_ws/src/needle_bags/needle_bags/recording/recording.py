"""The recorder's writing half: a queue that callbacks append to, and a worker that empties it."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from needle_bags.format.bag_writer import (
    CHUNK_SIZE,
    BagWriteError,
    BagWriter,
    refuse_existing_bag,
)
from needle_bags.recording.free_space import FreeSpace, megabytes
from needle_bags.recording.worker import Do, Job, Worker, WorkerThread
from needle_core.errors import UserError
from needle_core.files.bag_topic import BagTopic

FLUSH_PERIOD: Final = 0.1
# What waits for a slow disk at most, in bytes; more is dropped, and counted. Nearly three seconds
# of stereo images. Where images fill it, there is still an eighth more for what is small.
WAITING_LIMIT: Final = 128_000_000
_SHARE_FOR_SMALL: Final = 8
SMALL: Final = 65_536
# What a message takes in memory beside its data.
OVERHEAD: Final = 800
RESERVE: Final = 64_000_000
# Key of the custom data that says why a recording ended before it was told to.
ENDED_EARLY: Final = "recording_ended"
# Key of that which says how many messages of each topic are not in the bag, as JSON.
MESSAGES_LOST: Final = "messages_lost"
# The disk is looked at after so many bytes, and with every flush.
_LOOK_EVERY: Final = 2**20


@dataclasses.dataclass(frozen=True, slots=True)
class Received:
    """One message as it came.

    Attributes
    ----------
    topic : str
        Absolute name.
    data : bytes
        The message as CDR with its header.
    log_time, publish_time : int
        When it was received and sent, system clock [ns].
    sequence : int
        The publisher's own number of the message, 0 where it has none.
    """

    topic: str
    data: bytes
    log_time: int
    publish_time: int
    sequence: int = 0

    @property
    def memory(self) -> int:
        """Size [B]."""
        return len(self.data) + OVERHEAD


class Recording:
    """A bag that a worker fills, so that no disk delay reaches the subscriptions.

    Parameters
    ----------
    bag : BagWriter
        The bag; the worker's from now on.
    space : FreeSpace
        Of its disk: where none is left the recording ends in order.
    make_worker : callable
        Makes the worker from what does a job and what comes at the end.
    waiting_limit : int
        What waits for a slow disk at most [B], but for an eighth more of what is small; what is
        beyond is dropped, and counted.
    clock : callable
        Steady time [s].

    Attributes
    ----------
    error : str or None
        Why writing ended before its time; None while all is well.
    is_whole : bool
        Whether the bag is complete: after `close`, or after an early end in order.
    dropped : dict of str to int
        Messages for each topic that came and could not be written.
    """

    def __init__(
        self,
        bag: BagWriter,
        space: FreeSpace,
        make_worker: Callable[[Do, Job], Worker] = WorkerThread,
        waiting_limit: int = WAITING_LIMIT,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.space = space
        self._clock = clock
        self._bag = bag
        self._waiting_limit = waiting_limit
        self._numbers: dict[str, int] = {}
        self.error: str | None = None
        self.is_whole = False
        self.dropped: dict[str, int] = {}
        self._lost_before: dict[str, int] = {}
        self.bytes_received = 0
        self.messages_received = 0
        self._bytes_done = 0
        self._looked_at = self._flushed = 0
        self._next_flush = self._clock() + FLUSH_PERIOD
        self._worker = make_worker(self._do, self._end)

    @property
    def messages_waiting(self) -> int:
        """Messages received that the worker has not taken yet."""
        return self._worker.waiting

    @property
    def bytes_waiting(self) -> int:
        """Size in memory [B]."""
        return self.bytes_received - self._bytes_done + OVERHEAD * self.messages_waiting

    def add_topic(self, topic: BagTopic) -> None:
        """Announce a topic; before the first `append` with its name."""
        self._put(lambda: self._add_topic(topic))

    def append(self, message: Received) -> None:
        """Queue one message; it is dropped, and counted, where too much waits already."""
        is_small = len(message.data) <= SMALL
        room = self._waiting_limit // _SHARE_FOR_SMALL if is_small else 0
        if self.bytes_waiting > self._waiting_limit + room:
            self._drop(message.topic)
        else:
            self.append_all((message,))

    def append_all(self, messages: Sequence[Received]) -> None:
        """Queue messages that are in memory anyhow, however many."""
        for message in messages:
            if self.error is not None:
                self._drop(message.topic)
                continue
            self.bytes_received += len(message.data)
            self.messages_received += 1
            self._worker.put(lambda message=message: self._write(message))  # type: ignore[misc]

    def add_record(self, name: str, values: dict[str, str]) -> None:
        """Queue a metadata record, kept in the MCAP file as soon as it is known."""
        self._put(lambda: self._bag.add_metadata(name, values))

    def add_file(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Queue a file that the bag carries."""
        self._put(lambda: self._bag.add_attachment(name, media_type, data, time_ns))

    def set_custom_data(self, key: str, value: str) -> None:
        """Queue a text for metadata.yaml's `custom_data`."""
        self._worker.put(lambda: self._bag.set_custom_data(key, value))

    def close(self, lost_before: Mapping[str, int] | None = None) -> None:
        """Write all that waits, then index and metadata; `error` tells how it went.

        Parameters
        ----------
        lost_before : mapping of str to int
            Messages of each topic that never got here; the bag names them beside `dropped`.
        """
        self._lost_before = dict(lost_before or {})
        self._worker.finish()

    def _put(self, job: Job) -> None:
        """Queue what can be done only while data is written."""
        self._worker.put(lambda: job() if self.error is None else None)

    def _add_topic(self, topic: BagTopic) -> None:
        self._numbers[topic.name] = self._bag.add_topic(topic)

    def _write(self, message: Received) -> None:
        topic = message.topic
        if self.error is not None:
            self._drop(topic)
            return
        try:
            self._bag.write(
                self._numbers[topic],
                message.data,
                message.log_time,
                message.publish_time,
                message.sequence,
            )
        except Exception:
            self._drop(topic)
            raise
        self._bytes_done += len(message.data)

    def _drop(self, topic: str) -> None:
        self.dropped[topic] = self.dropped.get(topic, 0) + 1

    def _do(self, job: Job) -> float:
        """Do a job, and what the disk needs; after an early end messages are counted as dropped."""
        if self.error is None:
            self._write_on(job)
        else:
            job()
        return self._next_flush if self.error is None else self._clock() + FLUSH_PERIOD

    def _write_on(self, job: Job) -> None:
        try:
            job()
            self._tend_disk()
        except (BagWriteError, OSError) as error:
            self._end_early(str(error))
            return
        # A worker that ended in silence would leave all that comes after it waiting.
        except Exception as error:  # noqa: BLE001
            self.error = f"{type(error).__name__}: {error}"
        if self.error is not None:
            self._bag.set_custom_data(ENDED_EARLY, self.error)
            self._complete()

    def _tend_disk(self) -> None:
        """Write out where it is time; end the recording where there is no room for more."""
        is_due = self._clock() >= self._next_flush
        if is_due or self._bytes_done - self._looked_at >= _LOOK_EVERY:
            self._looked_at = self._bytes_done
            unwritten = min(CHUNK_SIZE, self._bytes_done - self._flushed)
            if self.space.usable() < unwritten:
                left = megabytes(self.space.usable() + self.space.reserve)
                self.error = f"the disk of {self._bag.directory} has only {left} left"
                return
        if is_due:
            self._bag.flush()
            self._flushed = self._bytes_done
            self._next_flush = self._clock() + FLUSH_PERIOD

    def _end(self) -> None:
        self._name_lost()
        if self.error is None:
            self._complete()
        if self.error is not None and self.is_whole:
            # What was dropped at the very end is known only now.
            self._name_lost()
            with contextlib.suppress(BagWriteError):
                self._bag.update_metadata()

    def _name_lost(self) -> None:
        lost = Counter(self._lost_before) + Counter(self.dropped)
        if lost:
            self._bag.set_custom_data(MESSAGES_LOST, json.dumps(lost))

    def _complete(self) -> None:
        try:
            self._bag.close()
            self.is_whole = True
        except (BagWriteError, OSError) as error:
            self._end_early(str(error))

    def _end_early(self, why: str) -> None:
        self.error = self.error or why
        self._bag.set_custom_data(ENDED_EARLY, self.error)
        with contextlib.suppress(BagWriteError):
            for topic, count in self._bag.end_early().items():
                self.dropped[topic] = self.dropped.get(topic, 0) + count
            self.is_whole = True


def open_recording(
    directory: Path,
    *,
    distribution: str = "jazzy",
    max_file_size: int = 0,
    compression: str = "none",
    reserve: int = RESERVE,
) -> Recording:
    """Begin a bag that a thread of its own fills.

    Parameters
    ----------
    directory : Path
        The bag.
    distribution : str
        ROS distribution of its message types.
    max_file_size : int
        Bytes of messages after which another data file is begun; 0: never.
    compression : str
        `none` or `zstd`.
    reserve : int
        Free bytes on the disk at which the recording ends in order (`FreeSpace`).

    Raises
    ------
    UserError
        If the directory holds a bag already or cannot be made, or the disk is full.
    """
    refuse_existing_bag(directory)
    space = _space(directory, reserve)
    bag = BagWriter(
        directory,
        distribution=distribution,
        max_file_size=max_file_size,
        compression=compression,
    )
    return Recording(bag, space)


def _space(directory: Path, reserve: int) -> FreeSpace:
    """Return the watch over the directory's disk; there must be room to begin."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        space = FreeSpace(directory, reserve)
    except OSError as error:
        raise UserError(f"cannot record into {directory}: {error.strerror}") from error
    usable = space.usable()
    if usable < 0:
        left, kept = megabytes(usable + space.reserve), megabytes(space.reserve)
        raise UserError(f"cannot record into {directory}: {left} free, {kept} are kept free")
    return space
