"""A recorder on a full, stalled, slow or broken disk, with the rig's own `Recording`."""

from __future__ import annotations

import errno
import io
import os
import random
import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import IO, Any

from needle_bags.format.bag_writer import BagWriter
from needle_bags.recording.recording import FreeSpace, Received, Recording
from needle_bags.recording.worker import Job, RunJob
from needle_core.component import Actions, Component, Input, Moment, Output, Timer
from needle_core.files.bag_topic import BagTopic
from scenario.faults import Fault, Kind
from scenario.monitors.bag_monitor import WAITING_LIMIT, BagMonitor

# Period of the worker, and shortest and longest duration of a job [s].
_WORK, _JOB = 0.005, (2e-6, 40e-6)
_SLOWEST_JOB = 0.005
# Free space at which a recording ends [B].
_RESERVE = 1_000_000
_FREE = 10**9


class Disk:
    """Disk of a recorder's bags: real files, with injected faults.

    Attributes
    ----------
    free : int
        Reported free space [B].
    error : int
        `errno` of every write; 0: no error.
    is_frozen : bool
        Whether writes never end.
    slowness : float
        Added duration of each job [s].
    """

    def __init__(self) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="needle_soak_"))
        self.free, self.error = _FREE, 0
        self.is_frozen = False
        self.slowness = 0.0
        self._count = 0

    def next_bag(self) -> Path:
        """Return the folder of the next bag."""
        self._count += 1
        return self._folder / f"bag_{self._count}"

    def spoil(self, fault: Fault) -> Callable[[], None]:
        """Begin a fault; returns the function that ends it."""
        if fault.kind is Kind.STUCK:
            self.is_frozen = True
        elif fault.kind is Kind.SLOW:
            self.slowness = fault.size * _SLOWEST_JOB
        elif fault.kind is Kind.OFF and fault.size < 0.5:
            # Other programs fill the disk, so that no free space is reported.
            self.free = 0
        else:
            self.error = errno.EIO if fault.kind is Kind.GARBAGE else errno.ENOSPC
        return self._mend

    def _mend(self) -> None:
        self.free, self.error, self.is_frozen, self.slowness = _FREE, 0, False, 0.0

    def close(self) -> None:
        """Remove all files of the disk."""
        shutil.rmtree(self._folder)


class _File(io.FileIO):
    def __init__(self, disk: Disk, path: Path) -> None:
        super().__init__(path, "xb")
        self._disk = disk

    def write(self, data: Any) -> int:
        if self._disk.error:
            raise OSError(self._disk.error, os.strerror(self._disk.error))
        return super().write(data)


class _Bag(BagWriter):
    def __init__(self, disk: Disk, directory: Path) -> None:
        self._disk = disk
        self.opened: list[_File] = []
        super().__init__(directory)

    def open_file(self, path: Path) -> IO[bytes]:
        self.opened.append(_File(self._disk, path))
        return io.BufferedWriter(self.opened[-1])


class _Space(FreeSpace):
    def __init__(self, disk: Disk) -> None:
        self._disk = disk
        self.reserve = _RESERVE

    def usable(self) -> int:
        return self._disk.free - self.reserve


class _Jobs:
    """A `Worker` whose jobs run when it is given time."""

    def __init__(self, do: RunJob, end: Job) -> None:
        self._do, self._end = do, end
        self._jobs: deque[Job] = deque()

    @property
    def waiting(self) -> int:
        return len(self._jobs)

    def put(self, job: Job) -> None:
        self._jobs.append(job)

    def work(self, seconds: float, cost: Callable[[], float]) -> None:
        """Run as many jobs as `seconds` allow, and flush if there are none."""
        if not self._jobs:
            self._do(lambda: None)
        while self._jobs and seconds > 0.0:
            seconds -= cost()
            self._do(self._jobs.popleft())

    def finish(self) -> None:
        while self._jobs:
            self._do(self._jobs.popleft())
        self._end()


class RecorderStandIn(Component):
    """Passes all received messages to a `Recording`, as text instead of CDR.

    Parameters
    ----------
    disk : Disk
        Disk of the bags.
    topics : iterable of Output
        Recorded topics.
    chance : Random
        Draws the durations of jobs.

    Attributes
    ----------
    recording : Recording
        The rig's own.
    """

    name = "recorder"

    def __init__(self, disk: Disk, topics: Iterable[Output], chance: random.Random) -> None:
        self._disk, self._chance = disk, chance
        self._now = 0.0
        self._count = 0
        self._killed_at: float | None = None
        self._refused_at: float | None = None
        self._bag = _Bag(disk, disk.next_bag())
        self._monitor = BagMonitor(self._bag.directory)
        workers: list[_Jobs] = []

        def make_worker(do: RunJob, end: Job) -> _Jobs:
            workers.append(_Jobs(do, end))
            return workers[0]

        self.recording = Recording(
            self._bag, _Space(disk), make_worker, WAITING_LIMIT, clock=lambda: self._now
        )
        self._jobs = workers[0]
        rows = []
        for output in topics:
            self.recording.add_topic(BagTopic(output.topic, "std_msgs/msg/String", "string data"))
            receive = partial(self._receive, output.topic)
            rows.append(Input(output.topic, output.message, receive, output.delivery))
        self.inputs = tuple(rows)
        self.timers = (Timer(_WORK, self._work),)

    def cut(self, now: float) -> None:
        """End as a killed process, whose files the kernel closes."""
        self._killed_at = now
        for file in self._bag.opened:
            file.close()

    def losses(self, *, check_killed: bool) -> list[str]:
        """End the recording unless it was killed; return the losses that its bag does not report.

        Parameters
        ----------
        check_killed : bool
            Whether to check the bag of a killed recorder: no other fault prevented its writing.
        """
        if self._killed_at is not None:
            return self._monitor.losses_after_kill(self._killed_at) if check_killed else []
        self.recording.close()
        if not self.recording.is_whole:
            if self._refused_at is None:
                self._note_refusal()
            if self._refused_at is None:
                return [f"{self._bag.directory} is not whole: {self.recording.error}"]
            # A disk that refused data leaves the same as a kill.
            return self._monitor.losses_after_kill(self._refused_at) if check_killed else []
        return self._monitor.losses_after_clean_end()

    def _receive(self, topic: str, message: Any, at: Moment) -> Actions:
        self._now = at.steady
        self._count += 1
        self._monitor.record(at.steady, topic)
        data = repr(message).encode()
        self.recording.append(Received(topic, data, at.stamp_ns, at.sent_ns, self._count))
        return ()

    def _work(self, at: Moment) -> Actions:
        self._now = at.steady
        if not self._disk.is_frozen:
            draw, slowness = self._chance.uniform, self._disk.slowness
            self._jobs.work(_WORK, lambda: draw(*_JOB) + slowness)
            self._note_refusal()
        return ()

    def _note_refusal(self) -> None:
        refused = (self.recording.error or "").startswith("cannot write")
        if refused and self._refused_at is None:
            self._refused_at = self._now
