"""Writing part of the recorder: callbacks fill a queue, and a worker writes it into the bag."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import json
import shutil
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
from needle_bags.recording.worker import Job, RunJob, Worker, WorkerThread
from needle_core.errors import UserError
from needle_core.files.bag_topic import BagTopic

FLUSH_PERIOD: Final = 0.1
# Backlog limit for a slow disk [B], nearly three seconds of stereo images; messages beyond it are
# dropped and counted. Small messages get another eighth, so that images cannot crowd them out.
WAITING_LIMIT: Final = 128_000_000
_SHARE_FOR_SMALL: Final = 8
SMALL: Final = 65_536
# Memory that a message takes in addition to its data [B].
OVERHEAD: Final = 800
RESERVE: Final = 64_000_000
# The reserve takes at most this share of a small disk.
LARGEST_RESERVE_SHARE: Final = 0.1
# custom_data key: reason why a recording ended early.
ENDED_EARLY: Final = "recording_ended"
# custom_data key: number of missing messages by topic, as JSON.
MESSAGES_LOST: Final = "messages_lost"
# The free space is checked after this many bytes, and at every flush.
_CHECK_EVERY: Final = 2**20
# <malloc.h>
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3


@dataclasses.dataclass(frozen=True, slots=True)
class Received:
    """A received message.

    Attributes
    ----------
    topic : str
        Absolute name.
    data : bytes
        The message as CDR with its header.
    log_time, publish_time : int
        Times of reception and sending, system clock [ns].
    sequence : int
        Sequence number of the publisher, 0 if it has none.
    """

    topic: str
    data: bytes
    log_time: int
    publish_time: int
    sequence: int = 0

    @property
    def memory(self) -> int:
        """Size in memory [B]."""
        return len(self.data) + OVERHEAD


class FreeSpace:
    """Free space of the disk that holds a directory.

    Parameters
    ----------
    directory : Path
        An existing directory.
    reserve : int
        Bytes to leave free; limited to `LARGEST_RESERVE_SHARE` of the disk.

    Attributes
    ----------
    reserve : int
        Bytes that are kept free.
    """

    def __init__(self, directory: Path, reserve: int) -> None:
        self._directory = directory
        largest = LARGEST_RESERVE_SHARE * shutil.disk_usage(directory).total
        self.reserve = min(reserve, int(largest))

    def usable(self) -> int:
        """Return the number of bytes that may still be written; negative below the reserve."""
        return shutil.disk_usage(self._directory).free - self.reserve


class Recording:
    """A bag that a worker fills, so that a slow disk never delays the subscriptions.

    Parameters
    ----------
    bag : BagWriter
        The bag; only the worker uses it from now on.
    space : FreeSpace
        Free space of its disk; the recording ends cleanly when none is usable.
    make_worker : callable
        Creates the worker, given a job runner and a closing function.
    waiting_limit : int
        Backlog limit [B], plus an eighth for small messages; messages beyond it are dropped.
    clock : callable
        Steady time [s].

    Attributes
    ----------
    error : str or None
        Reason why the recording ended early; None if it did not.
    is_whole : bool
        Whether the bag is complete. If data could not be written, it is not, and `recover`
        restores the written messages.
    dropped : dict of str to int
        Number of received messages that were not written, by topic.
    """

    def __init__(
        self,
        bag: BagWriter,
        space: FreeSpace,
        make_worker: Callable[[RunJob, Job], Worker] = WorkerThread,
        waiting_limit: int = WAITING_LIMIT,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.space = space
        self._clock = clock
        self._bag = bag
        self._waiting_limit = waiting_limit
        self.error: str | None = None
        self.is_whole = False
        self.dropped: dict[str, int] = {}
        self._lost_before: dict[str, int] = {}
        self.bytes_received = 0
        self.messages_received = 0
        self._bytes_written = 0
        self._bytes_checked = self._bytes_flushed = 0
        self._next_flush = self._clock() + FLUSH_PERIOD
        self._worker = make_worker(self._run_job, self._end)

    @property
    def messages_waiting(self) -> int:
        """Number of received messages that are still queued."""
        return self._worker.waiting

    @property
    def bytes_waiting(self) -> int:
        """Memory of the queued messages [B]."""
        return self.bytes_received - self._bytes_written + OVERHEAD * self.messages_waiting

    def add_topic(self, topic: BagTopic) -> None:
        """Announce a topic; required before the first `append` with its name."""
        self._put(lambda: self._bag.add_topic(topic))

    def append(self, message: Received) -> None:
        """Queue a message; drop and count it if the backlog limit is reached."""
        is_small = len(message.data) <= SMALL
        extra = self._waiting_limit // _SHARE_FOR_SMALL if is_small else 0
        if self.bytes_waiting > self._waiting_limit + extra:
            self._drop(message.topic)
        else:
            self.append_all((message,))

    def append_all(self, messages: Sequence[Received]) -> None:
        """Queue messages regardless of the backlog limit."""
        for message in messages:
            if self.error is not None:
                self._drop(message.topic)
                continue
            self.bytes_received += len(message.data)
            self.messages_received += 1
            self._worker.put(lambda message=message: self._write(message))  # type: ignore[misc]

    def add_record(self, name: str, values: dict[str, str]) -> None:
        """Queue a metadata record; unlike metadata.yaml it survives a kill."""
        self._put(lambda: self._bag.add_metadata(name, values))

    def set_custom_data(self, key: str, value: str) -> None:
        """Queue an entry of `custom_data` in metadata.yaml."""
        self._worker.put(lambda: self._bag.set_custom_data(key, value))

    def flush_idle(self) -> None:
        """Flush if it is due and nothing is queued; call this every `FLUSH_PERIOD`."""
        if not self.messages_waiting:
            self._worker.put(lambda: None)

    def close(self, lost_before: Mapping[str, int] | None = None) -> None:
        """Write all queued messages, the index and the metadata; see `error` and `is_whole`.

        Parameters
        ----------
        lost_before : mapping of str to int
            Number of messages by topic that were lost before they were appended; the bag lists
            them together with `dropped`.
        """
        self._lost_before = dict(lost_before or {})
        self._worker.finish()

    def _put(self, job: Callable[[], object]) -> None:
        """Queue a job that is skipped once the recording has ended."""

        def run() -> None:
            if self.error is None:
                job()

        self._worker.put(run)

    def _write(self, message: Received) -> None:
        topic = message.topic
        if self.error is not None:
            self._drop(topic)
            return
        try:
            self._bag.write(
                topic,
                message.data,
                message.log_time,
                message.publish_time,
                message.sequence,
            )
        except Exception:
            self._drop(topic)
            raise
        self._bytes_written += len(message.data)

    def _drop(self, topic: str) -> None:
        self.dropped[topic] = self.dropped.get(topic, 0) + 1

    def _run_job(self, job: Job) -> None:
        """Run a job, then flush and check the disk if this is due."""
        if self.error is not None:
            job()
            return
        try:
            job()
            self._check_disk()
        except (BagWriteError, OSError) as error:
            self._abandon(error)
        # An exception must not end the worker, or all later messages would stay queued.
        except Exception as error:  # noqa: BLE001
            self._end_early(f"{type(error).__name__}: {error}")

    def _check_disk(self) -> None:
        """Flush if it is due; end the recording if the disk has no usable space."""
        is_due = self._clock() >= self._next_flush
        if is_due or self._bytes_written - self._bytes_checked >= _CHECK_EVERY:
            self._bytes_checked = self._bytes_written
            unwritten = min(CHUNK_SIZE, self._bytes_written - self._bytes_flushed)
            if self.space.usable() < unwritten:
                left = megabytes(self.space.usable() + self.space.reserve)
                self._end_early(f"the disk of {self._bag.directory} has only {left} free")
                return
        if is_due:
            self._bag.flush()
            self._bytes_flushed = self._bytes_written
            self._next_flush = self._clock() + FLUSH_PERIOD

    def _end_early(self, reason: str) -> None:
        """Complete the bag and stop writing."""
        self.error = reason
        self._bag.set_custom_data(ENDED_EARLY, reason)
        self._complete()

    def _end(self) -> None:
        self._store_lost_counts()
        if self.error is None:
            self._complete()
        elif self.is_whole:
            # Messages were dropped after the early end.
            with contextlib.suppress(BagWriteError):
                self._bag.update_metadata()

    def _store_lost_counts(self) -> None:
        lost = Counter(self._lost_before) + Counter(self.dropped)
        if lost:
            self._bag.set_custom_data(MESSAGES_LOST, json.dumps(lost))

    def _complete(self) -> None:
        try:
            self._bag.close()
            self.is_whole = True
        except (BagWriteError, OSError) as error:
            self._abandon(error)

    def _abandon(self, error: Exception) -> None:
        self.error = self.error or str(error)
        self._bag.abandon()


def open_recording(
    directory: Path,
    *,
    distribution: str = "jazzy",
    max_file_size: int = 0,
    compression: str = "none",
    reserve: int = RESERVE,
) -> Recording:
    """Create a bag and the thread that fills it.

    Parameters
    ----------
    directory : Path
        The bag.
    distribution : str
        ROS distribution of its message types.
    max_file_size : int
        Bytes of messages after which a new data file is started; 0 for never.
    compression : str
        `none` or `zstd`.
    reserve : int
        Free bytes on the disk at which the recording ends cleanly (`FreeSpace`).

    Raises
    ------
    UserError
        If the directory already contains a bag or cannot be created, or the disk is full.
    """
    refuse_existing_bag(directory)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        space = FreeSpace(directory, reserve)
    except OSError as error:
        raise UserError(f"cannot record into {directory}: {error.strerror}") from error
    usable = space.usable()
    if usable < 0:
        left, kept = megabytes(usable + space.reserve), megabytes(space.reserve)
        raise UserError(f"cannot record into {directory}: {left} free, minimum {kept}")
    bag = BagWriter(
        directory,
        distribution=distribution,
        max_file_size=max_file_size,
        compression=compression,
    )
    return Recording(bag, space)


def megabytes(count: float) -> str:
    """Return a number of bytes as MB or GB."""
    return f"{count / 1e6:.0f} MB" if count < 10e9 else f"{count / 1e9:.0f} GB"


def reuse_freed_memory() -> None:
    """Make the C library reuse freed blocks of the size of a chunk.

    By default it returns each block to the kernel and clears a new one for the next chunk, which
    takes two thirds of the CPU time when images are recorded.
    """
    with contextlib.suppress(AttributeError, OSError):  # other C libraries lack it
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_MMAP_THRESHOLD, 32 * 2**20)
        mallopt(_M_TRIM_THRESHOLD, 64 * 2**20)
