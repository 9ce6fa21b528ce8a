"""A disk that fills, stands still, is slow or broken, and what a killed process leaves on it."""

from __future__ import annotations

import io
import os
import shutil
import tempfile
from collections import deque
from functools import partial
from pathlib import Path
from typing import IO, Any

from needle_bags.format.bag_writer import BagWriter
from needle_bags.recording.free_space import FreeSpace
from needle_bags.recording.recording import Recording
from needle_bags.recording.worker import Do, Job, nothing
from needle_verification.soak.virtual_timers import VirtualAlarm
from needle_verification.soak.virtual_world import NANOSECONDS, VirtualProcess

# What a job of the recording takes [ns], at least and at most.
_JOB_NS = (2_000, 40_000)
# A recording ends in order where no more is left [B].
_RESERVE = 1_000_000
ROOM = 10**9
"""What is left on a disk that nobody else fills [B]."""
# How often a disk that stands still is asked again [ns].
_LOOK_NS = 5_000_000
WAITING_LIMIT = 400_000
"""What waits for this disk at most [B]; a real recorder may keep far more."""


class VirtualDisk:
    """The disk of a recorder's bags: real files, spoilt on their way.

    Attributes
    ----------
    room : int
        What is said to be left [B].
    error : int
        What every write meets, as `errno` has it; 0: nothing.
    stands_still : bool
        Whether no write ends.
    slowness_ns : int
        What each job takes longer [ns].
    """

    def __init__(self) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="needle_soak_"))
        self.room = ROOM
        self.error = 0
        self.stands_still = False
        self.slowness_ns = 0
        self._count = 0

    def next_bag(self) -> Path:
        """Return where the next recorder records."""
        self._count += 1
        return self._folder / f"bag_{self._count}"

    def close(self) -> None:
        """Remove all that is on it."""
        shutil.rmtree(self._folder)


class DiskUser:
    """A process that records on a disk, until it ends.

    Parameters
    ----------
    disk : VirtualDisk
        The disk.
    process : VirtualProcess
        The recorder's.

    Attributes
    ----------
    recording : Recording or None
        Once it has begun.
    """

    def __init__(self, disk: VirtualDisk, process: VirtualProcess) -> None:
        self.disk = disk
        self.process = process
        self.recording: Recording | None = None
        self._files: list[_File] = []

    def open_recording(self, directory: Path, *, reserve: int, **settings: Any) -> Recording:
        """Begin a recording, as `needle_bags` does, that this disk may spoil."""
        del reserve
        bag, space = _Bag(self, directory, **settings), _Space(self.disk)
        self.recording = Recording(bag, space, partial(_DiskWorker, self), WAITING_LIMIT)
        return self.recording

    def open_file(self, path: Path) -> IO[bytes]:
        """Return a new file; what it still has to write when the process is killed is lost."""
        file = _File(self.disk, path)
        self._files.append(file)
        return io.BufferedWriter(file)

    def cut(self) -> None:
        """End, as the kernel ends it for a process that is gone."""
        for file in self._files:
            file.close()


class _File(io.FileIO):
    def __init__(self, disk: VirtualDisk, path: Path) -> None:
        super().__init__(path, "xb")
        self._disk = disk

    def write(self, data: Any) -> int:
        if self._disk.error:
            raise OSError(self._disk.error, os.strerror(self._disk.error))
        return super().write(data)


class _Bag(BagWriter):
    def __init__(self, user: DiskUser, directory: Path, **settings: Any) -> None:
        self._user = user
        super().__init__(directory, **settings)

    def open_file(self, path: Path) -> IO[bytes]:
        return self._user.open_file(path)


class _Space(FreeSpace):
    def __init__(self, disk: VirtualDisk) -> None:
        self._disk = disk
        self.reserve = _RESERVE

    def usable(self) -> int:
        return self._disk.room - self.reserve


class _DiskWorker:
    """Does the jobs of a recording beside the node's own thread, each in its time."""

    def __init__(self, user: DiskUser, do: Do, end: Job) -> None:
        self._user = user
        self._do = do
        self._end = end
        self._jobs: deque[Job] = deque()
        self._world = user.process.world
        self._chance = self._world.chance("disk", user.process.name)
        self._free_ns = self._world.steady_ns
        self._planned_ns: int | None = None
        self._alarm = VirtualAlarm(self._world, user.process.do_concurrently, self._take)
        self._plan(self._free_ns)

    @property
    def waiting(self) -> int:
        """Jobs that have not been taken yet."""
        return len(self._jobs)

    def put(self, job: Job) -> None:
        """Queue a job."""
        self._jobs.append(job)
        self._plan(self._world.steady_ns)

    def finish(self) -> None:
        """Do all at once: who waits for the end does nothing meanwhile."""
        self._alarm.cancel()
        while self._jobs:
            self._do(self._jobs.popleft())
        self._end()

    def _plan(self, due_ns: int) -> None:
        due_ns = max(due_ns, self._free_ns)
        if self._planned_ns is not None and self._planned_ns <= due_ns:
            return
        self._planned_ns = due_ns
        self._alarm.set(due_ns)

    def _take(self) -> None:
        self._planned_ns = None
        disk, world = self._user.disk, self._world
        if disk.stands_still:
            self._plan(world.steady_ns + _LOOK_NS)
            return
        self._free_ns = world.steady_ns + self._chance.randint(*_JOB_NS) + disk.slowness_ns
        due = self._do(self._jobs.popleft() if self._jobs else nothing)
        # Time in seconds is rounded: what is due by less than that would not end.
        due_ns = max(round(due * NANOSECONDS), world.steady_ns + 1)
        self._plan(world.steady_ns if self._jobs else due_ns)
