"""Recordings of numbered messages: at full rate, and with a recorder that is killed."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import Reader

from campaign.checking import bag_read_error, busy
from needle_bags.reading.bag_messages import read_contents
from needle_bags.recording.recording import MESSAGES_LOST
from needle_bags.recovery.bag_recovery import recover_bag
from needle_core.errors import UserError
from needle_core.process.ros_domain import reserve_domain_id

# Bytes of the stamp's nanoseconds, which are the number of the message.
_NUMBER = slice(8, 12)
_START_UP = 30.0
_LOAD = "campaign.trials.recording_load"


def record_full_rate(folder: Path, duration: float, others: int = 2) -> dict[str, Any]:
    """Record a rig at full rate for a duration [s], while other processes load the CPU.

    Returns
    -------
    dict
        Number of messages `sent`; by topic the number `missing` in the bag, and `counted` as lost
        by the recorder; the recorder's `share` of a core, its `memory` and by how much that `grew`
        in the second half [MB], the write rate `MB_per_s`, and the exit `code`.
    """
    bag = folder / "full_rate"
    with (
        reserve_domain_id() as domain,
        recorder(domain, bag) as recording,
        busy(others),
        _process(domain, _LOAD, str(duration)) as load,
    ):
        begin, before = time.monotonic(), _processor_time(recording.pid)
        memory: list[float] = []
        while load.poll() is None and recording.poll() is None:
            time.sleep(0.5)
            memory.append(_memory(recording.pid))
        share = (_processor_time(recording.pid) - before) / (time.monotonic() - begin)
        output, _ = load.communicate()
        recording.send_signal(signal.SIGINT)
        code = recording.wait(60.0)
    if load.returncode or not output.strip():
        raise UserError(f"the load did not run: exit code {load.returncode}")
    sent = dict(json.loads(output.strip().splitlines()[-1]))
    kept = {topic: len(set(found)) for topic, found in _numbers(bag).items()}
    missing = {topic: count - kept.get(topic, 0) for topic, count in sent.items()}
    lost = json.loads(read_contents(bag).custom_data.get(MESSAGES_LOST, "{}"))
    half, quarter = len(memory) // 2, max(1, len(memory) // 8)
    size = sum(file.stat().st_size for file in bag.glob("*.mcap"))
    return {
        "sent": sum(sent.values()),
        "missing": {topic: count for topic, count in missing.items() if count},
        "counted": {topic: lost[topic] for topic in sent if topic in lost},
        "share": share,
        "memory": memory[-1],
        "grew": float(np.mean(memory[-quarter:]) - np.mean(memory[half : half + quarter])),
        "MB_per_s": size / duration / 1e6,
        "code": code,
    }


def record_and_kill(folder: Path, moments: int, *argv: str) -> Iterator[tuple[str, float, int]]:
    """Kill a recorder at random moments, and recover each bag.

    Yields
    ------
    str, float, int
        Reason if the bag cannot be read; time from its last message to the kill [s]; number of
        messages missing between others of their topic.
    """
    rng = np.random.default_rng(5)
    for number in range(moments):
        bag = folder / f"killed_{number}"
        # A new domain each time: shared memory of a killed process may block discovery.
        with (
            reserve_domain_id() as domain,
            recorder(domain, bag) as recording,
            _process(domain, _LOAD, "3600", *argv),
        ):
            deadline = time.monotonic() + _START_UP
            # Wait for the first chunk of data on the disk.
            while sum(file.stat().st_size for file in bag.glob("*.mcap")) < 50_000:
                if time.monotonic() > deadline or recording.poll() is not None:
                    raise UserError(f"the recorder does not record into {bag}")
                time.sleep(0.01)
            time.sleep(float(rng.uniform(0.0, 2.0)))
            killed_at = time.time_ns()
            recording.kill()
            recording.wait(10.0)
        recover_bag(bag)
        if why := bag_read_error(bag):
            yield why, 0.0, 0
            continue
        # A best-effort topic may lose messages before the discovery of the recorder.
        gaps = sum(
            max(found) - min(found) + 1 - len(set(found))
            for topic, found in _numbers(bag).items()
            if topic != "/device/hold"
        )
        with Reader(bag) as reader:
            yield "", (killed_at - (reader.end_time - 1)) * 1e-9, gaps


def recorder(
    domain: int, bag: Path, name: str = "recorder"
) -> contextlib.AbstractContextManager[subprocess.Popen[str]]:
    """Start a recorder with this node name; kill it at the end."""
    argv = ["--ros-args", "-r", f"__node:={name}", "-p", f"bag:={bag}"]
    return _process(domain, "needle_bags.ros.recorder", *argv)


@contextlib.contextmanager
def _process(domain: int, module: str, *argv: str) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [sys.executable, "-m", module, *argv],
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


def _numbers(bag: Path) -> dict[str, list[int]]:
    """Return the numbers of the messages in a bag, by topic."""
    found: dict[str, list[int]] = {}
    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            if connection.topic not in ("/rosout", "/diagnostics", "/parameter_events"):
                number = int.from_bytes(data[_NUMBER], "little")
                found.setdefault(connection.topic, []).append(number)
    return found


def _processor_time(pid: int) -> float:
    """Return the CPU time of a process [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _memory(pid: int) -> float:
    """Return the private memory of a process [MB]."""
    fields = Path(f"/proc/{pid}/statm").read_text("utf-8").split()
    return (int(fields[1]) - int(fields[2])) * os.sysconf("SC_PAGE_SIZE") / 1e6
