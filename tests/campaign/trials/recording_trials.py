"""Recordings of numbered messages: at full rate, and killed at random moments."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader

from campaign.checking import unreadable
from needle_bags.reading.bag_files import read_contents
from needle_bags.recording.recording import MESSAGES_LOST
from needle_bags.recovery.bag_recovery import recover_bag
from needle_bringup.descendants import busy
from needle_core.errors import UserError
from needle_core.process.ros_domain import own_domain

# The first bytes of every message: the encoding, then the stamp's seconds; its nanoseconds are the
# message's number.
_NUMBER = slice(8, 12)
_START_UP = 30.0
_LOAD = "recording_load"
_MODULES = {
    "recorder": "needle_bags.ros.recorder",
    _LOAD: "campaign.trials.recording_load",
}
_SECOND = 1_000_000_000


@dataclasses.dataclass(frozen=True)
class FullRate:
    """Outcome of a recording at full rate.

    Attributes
    ----------
    bag : Path
        The bag.
    sent, missing, counted : dict of str to int
        For each topic: messages that were sent, that are not in the bag, and that the recorder
        says it lost.
    processor_share : float
        Processor time of the recorder over the time, of one core.
    memory_mb, growth_mb : float
        The recorder's memory at the end, and by how much it grew in the second half [MB].
    megabytes_per_s : float
        Written to the disk.
    exit_code : int
        The recorder's.
    """

    bag: Path
    sent: dict[str, int]
    missing: dict[str, int]
    counted: dict[str, int]
    processor_share: float
    memory_mb: float
    growth_mb: float
    megabytes_per_s: float
    exit_code: int


@dataclasses.dataclass(frozen=True)
class Killed:
    """Outcome of `recover` on a killed recording.

    Attributes
    ----------
    messages : int
        Messages in it.
    age_s : float
        From its last message to the kill [s].
    gaps : int
        Messages missing between others of their topic.
    unreadable : str
        Why rosbags or mcap do not open it; empty if they do.
    """

    messages: int
    age_s: float
    gaps: int
    unreadable: str


def record_full_rate(folder: Path, duration: float, *, burners: int = 2) -> FullRate:
    """Record what a rig at full rate sends, while `burners` processes keep the cores busy."""
    bag = folder / "full_rate"
    with (
        own_domain() as domain,
        _process(domain, "recorder", bag=str(bag)) as recorder,
        busy(burners),
        _process(domain, _LOAD, duration=duration) as load,
    ):
        begin, before = time.monotonic(), _processor_time(recorder.pid)
        memory: list[float] = []
        while load.poll() is None and recorder.poll() is None:
            time.sleep(0.5)
            memory.append(_memory(recorder.pid))
        share = (_processor_time(recorder.pid) - before) / (time.monotonic() - begin)
        output, _ = load.communicate()
        recorder.send_signal(signal.SIGINT)
        code = recorder.wait(60.0)
    if load.returncode or not output.strip():
        raise UserError(f"the load did not run: exit code {load.returncode}")
    sent = dict(json.loads(output.strip().splitlines()[-1]))
    kept = {topic: len(set(found)) for topic, found in _numbers(bag).items()}
    half, quarter = len(memory) // 2, max(1, len(memory) // 8)
    growth = np.mean(memory[-quarter:]) - np.mean(memory[half : half + quarter])
    size = sum(file.stat().st_size for file in bag.glob("*.mcap"))
    return FullRate(
        bag,
        sent,
        {topic: count - kept.get(topic, 0) for topic, count in sent.items()},
        json.loads(read_contents(bag).custom_data.get(MESSAGES_LOST, "{}")),
        share,
        memory[-1],
        float(growth),
        size / duration / 1e6,
        code,
    )


def record_and_kill(
    folder: Path, moments: int, seed: int, *, images: bool = True
) -> Iterator[Killed]:
    """Kill a recorder at random moments, recover each time what it leaves."""
    rng = np.random.default_rng(seed)
    for number in range(moments):
        bag = folder / f"killed_{'images' if images else 'small'}_{number}"
        # A domain for each: what a killed process leaves in shared memory may keep the next one
        # from hearing the same partners.
        with (
            own_domain() as domain,
            _process(domain, "recorder", bag=str(bag)) as recorder,
            _process(domain, _LOAD, duration=3600.0, images=images),
        ):
            _wait_until_recording(bag, recorder)
            time.sleep(float(rng.uniform(0.0, 2.0)))
            killed_at = time.time_ns()
            recorder.kill()
            recorder.wait(10.0)
        yield _recovered(bag, killed_at)


def _recovered(bag: Path, killed_at: int) -> Killed:
    messages = recover_bag(bag).messages
    why = unreadable(bag)
    if why:
        return Killed(messages, 0.0, 0, why)
    gaps = 0
    for topic, found in _numbers(bag).items():
        # A best-effort topic may lose what is sent before the recorder is known to it, no more.
        span = max(found) - min(found) + 1
        if topic != "/device/hold":
            gaps += span - len(set(found))
    with Reader(bag) as reader:
        age = (killed_at - (reader.end_time - 1)) / _SECOND
    return Killed(messages, age, gaps, "")


def _numbers(bag: Path) -> dict[str, list[int]]:
    """Return the numbers of the load's messages in a bag, for each topic."""
    found: dict[str, list[int]] = {}
    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            if connection.topic not in ("/rosout", "/diagnostics", "/parameter_events"):
                number = int.from_bytes(data[_NUMBER], "little")
                found.setdefault(connection.topic, []).append(number)
    return found


def _wait_until_recording(bag: Path, recorder: subprocess.Popen[str]) -> None:
    """Wait until the first chunk of data is on the disk."""
    end = time.monotonic() + _START_UP
    while time.monotonic() < end and recorder.poll() is None:
        if sum(file.stat().st_size for file in bag.glob("*.mcap")) > 50_000:
            return
        time.sleep(0.01)
    raise UserError(f"the recorder does not record into {bag}")


@contextlib.contextmanager
def _process(
    domain: int, node: str, **parameters: str | float | bool
) -> Iterator[subprocess.Popen[str]]:
    words = [sys.executable, "-m", _MODULES[node], "--ros-args"]
    for name, value in parameters.items():
        words += ["-p", f"{name}:={str(value).lower() if isinstance(value, bool) else value}"]
    with subprocess.Popen(
        words,
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def _processor_time(pid: int) -> float:
    """Return the processor time that a process has taken [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _memory(pid: int) -> float:
    """Return the memory of a process that is its own [MB]: without what it shares."""
    try:
        fields = Path(f"/proc/{pid}/statm").read_text("utf-8").split()
    except OSError:
        return 0.0
    return (int(fields[1]) - int(fields[2])) * os.sysconf("SC_PAGE_SIZE") / 1e6
