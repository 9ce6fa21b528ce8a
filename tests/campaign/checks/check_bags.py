"""Step E: bags that lose nothing and open everywhere, and nodes that end in order."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from campaign.checking import (
    Check,
    Finding,
    Workbench,
    diagnostics,
    payloads,
    unreadable,
)
from campaign.checks import check_rerun
from campaign.trials.recording_trials import (
    FullRate,
    Killed,
    record_and_kill,
    record_full_rate,
)
from campaign.trials.signal_trials import Ended, signal_trials
from needle_bringup.descendants import ran

DURATION = 60.0
MOMENTS = 50
PROCESSOR_SHARE = 0.35
MEMORY_GROWTH_MB = 5.0
LAST_SECONDS = 0.5
SMALL_DISK = "40m"
SIGNALS = 200
# A bag is completed first: last words are heard for up to a second, and a disk may be slow.
LONGEST_END = {"recorder": 10.0}
# Launchers wait so long before they send SIGTERM.
LONGEST_END_OF_OTHERS = 5.0
_END_CODES = (0, 130)
_COMMANDS = "/device/joint_trajectory"
_POLICIES = ("history", "reliability", "durability", "liveliness")
_TEXTS = ("storage_identifier", "compression_format", "compression_mode", "ros_distro")


def full_rate(bench: Workbench, duration: float = DURATION) -> Iterator[Finding]:
    """Record stereo at 2 x 30 Hz with everything else while both cores are busy."""
    seen = record_full_rate(bench.folder, duration)
    yield from _rate_findings(seen, duration)
    yield from bag_findings("full_rate", seen.bag)


def _rate_findings(seen: FullRate, duration: float) -> Iterator[Finding]:
    missing = {topic: count for topic, count in seen.missing.items() if count}
    yield Finding(
        "full_rate_missing",
        f"{sum(seen.sent.values())} messages in {duration:.0f} s, both cores busy: missing",
        "0, counted at the source",
        f"{sum(missing.values())} {missing or ''} ({seen.megabytes_per_s:.0f} MB/s)".strip(),
        not missing and seen.exit_code == 0,
    )
    counted = {topic: seen.counted[topic] for topic in seen.sent if topic in seen.counted}
    yield Finding(
        "full_rate_counted",
        "what the recorder itself counts as lost",
        "just that",
        f"{sum(counted.values())} {counted or ''}".strip(),
        counted == missing,
    )
    yield Finding(
        "full_rate_processor",
        "the recorder's processor time",
        f"<= {PROCESSOR_SHARE:.0%} of a core",
        f"{seen.processor_share:.1%}",
        seen.processor_share <= PROCESSOR_SHARE,
    )
    yield Finding(
        "full_rate_memory",
        "the recorder's memory",
        f"grows <= {MEMORY_GROWTH_MB:g} MB in the second half",
        f"{seen.growth_mb:+.1f} MB, {seen.memory_mb:.0f} MB at the end",
        seen.growth_mb <= MEMORY_GROWTH_MB,
    )


def killed(bench: Workbench, moments: int = MOMENTS) -> Iterator[Finding]:
    """Kill the recorder at random moments, with images and without; recover."""
    for images in (True, False):
        count = (moments + images) // 2
        found = list(record_and_kill(bench.folder, count, seed=5, images=images))
        what = "stereo images" if images else "small messages"
        yield _killed_finding(f"killed_{'images' if images else 'small'}", what, found)
        for path in bench.folder.glob("killed_*"):
            shutil.rmtree(path)


def _killed_finding(key: str, what: str, found: list[Killed]) -> Finding:
    age = max(one.age_s for one in found)
    gaps = sum(one.gaps for one in found)
    why = [one.unreadable for one in found if one.unreadable]
    return Finding(
        key,
        f"kill -9 at {len(found)} random moments, {what}, then recover",
        f"rosbags and mcap open all, at most the last {LAST_SECONDS:g} s missing, no gaps",
        f"{len(found) - len(why)} open, at most {age:.2f} s missing, {gaps} gaps "
        + "; ".join(why[:1]),
        not why and age <= LAST_SECONDS and gaps == 0,
    )


def disk_full(bench: Workbench) -> Iterator[Finding]:
    """Let the bag's disk fill in the middle of a run."""
    usual = bench.run("disk_usual", "--seed", "41")
    with _small_disk(bench.folder / "disk") as disk:
        started = bench.start("disk/full", "--seed", "41")
        witness = _witness(started.domain(), bench.folder / "witness")
        run = started.wait()
        witness.terminate()
        witness.wait(30.0)
        reached = re.search(r"inserted ([\d.]+) mm in (\d+) steps", run.output)
        commands, wanted, kept = (
            payloads(bag, [_COMMANDS])[_COMMANDS]
            for bag in (bench.folder / "witness", usual.bag, run.bag)
        )
        same = bool(commands) and commands == wanted[-len(commands) :]
        yield Finding(
            "disk_full_steering",
            f"a disk of {disk} that fills: steering goes on",
            f"120 mm, the same commands as ever (the witness' {len(commands)} last ones)",
            f"{reached[1] if reached else '?'} mm, commands " + ("the same" if same else "differ"),
            bool(reached and float(reached[1]) == 120.0) and same,
        )
        why = unreadable(run.bag)
        yield Finding(
            "disk_full_bag",
            "the bag that filled it",
            "opens, and holds the beginning",
            why or f"opens, {len(kept)} of {len(wanted)} commands",
            not why and 0 < len(kept) < len(wanted) and kept == wanted[: len(kept)],
        )
    told = {m for level, _, m in diagnostics(bench.folder / "witness") if level == 2}
    warned = {m for level, _, m in diagnostics(bench.folder / "witness") if level == 1}
    reason = [text for text in told if "the disk of" in text]
    warning = [text for text in warned if "nearly full" in text]
    yield Finding(
        "disk_full_reason",
        "the reason in /diagnostics",
        "a warning, then an error with the reason",
        f"{(warning or ['no warning'])[0]}; {(reason or ['no error'])[0]}",
        bool(reason and warning),
    )


def bag_format(bench: Workbench) -> Iterator[Finding]:
    """Look at a run's bag with rosbags, mcap and rosbag2's own rules."""
    yield from bag_findings("bag_format", bench.run("disk_usual", "--seed", "41").bag)


def bag_findings(key: str, bag: Path) -> Iterator[Finding]:
    """Look at a bag with rosbags, mcap and rosbag2's own rules."""
    why = unreadable(bag)
    yield Finding(
        f"{key}_readers", "rosbags and mcap read the bag", "all messages", why or "all", not why
    )
    faults = [*_breaks_of_rules(bag), *_wrong_types(bag)]
    yield Finding(
        f"{key}_rules",
        "metadata version 9 by rosbag2's rules; type hashes and QoS as rosbags has them",
        "nothing amiss",
        "; ".join(faults) or "nothing amiss",
        not faults,
    )


def _breaks_of_rules(bag: Path) -> Iterator[str]:
    """Yield what rosbag2's reader of metadata.yaml would refuse."""
    information = _information(bag)
    topics = information["topics_with_message_count"]
    spans = [information, *information["files"]]
    times = [span["starting_time"]["nanoseconds_since_epoch"] for span in spans]
    times += [span["duration"]["nanoseconds"] for span in spans]
    rules = {
        "version 9": information["version"] == 9,
        "texts": all(isinstance(information[name], str) for name in _TEXTS),
        "times": all(isinstance(time, int) and time >= 0 for time in times),
        "relative_file_paths": information["relative_file_paths"]
        == [file["path"] for file in information["files"]],
        "counts": information["message_count"] == sum(topic["message_count"] for topic in topics),
        "custom_data": all(
            isinstance(text, str) for text in (information["custom_data"] or {}).values()
        ),
    }
    yield from (f"metadata.yaml: {rule}" for rule, kept in rules.items() if not kept)
    for topic in topics:
        metadata = topic["topic_metadata"]
        policies = [
            profile[name] for profile in metadata["offered_qos_profiles"] for name in _POLICIES
        ]
        if metadata["serialization_format"] != "cdr" or not all(
            isinstance(policy, str) for policy in policies
        ):
            yield f"metadata.yaml: {metadata['name']}"


def _information(bag: Path) -> dict[str, Any]:
    content = yaml.safe_load((bag / "metadata.yaml").read_text("utf-8"))
    return dict(content["rosbag2_bagfile_information"])


def _wrong_types(bag: Path) -> Iterator[str]:
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(bag) as reader:
        for connection in reader.connections:
            if connection.digest != store.hash_rihs01(connection.msgtype):
                yield f"{connection.topic}: type hash {connection.digest}"
            assert isinstance(connection.ext, ConnectionExtRosbag2)
            if not connection.ext.offered_qos_profiles and connection.msgcount:
                yield f"{connection.topic}: no QoS"
    for name in _information(bag)["relative_file_paths"]:
        # A file alone must say the same as the directory.
        with Reader(bag / name) as single, Reader(bag) as reader:
            known = {c.topic: c for c in reader.connections}
            for connection in single.connections:
                if connection.ext != known[connection.topic].ext:
                    yield f"{connection.topic}: QoS differs between metadata.yaml and {name}"


def signals(bench: Workbench, trials: int = SIGNALS) -> Iterator[Finding]:
    """Send SIGINT, SIGINT twice, SIGTERM or SIGHUP to all nodes at random moments."""
    for burners, key in ((0, "signals"), (2, "signals_busy")):
        folder = bench.folder / key
        folder.mkdir()
        found = list(signal_trials(folder, trials // 2, seed=burners, burners=burners))
        shutil.rmtree(folder)
        yield _signal_finding(key, found, "both cores busy" if burners else "otherwise idle")


def _signal_finding(key: str, found: list[Ended], load: str) -> Finding:
    slowest = {
        node: max(one.seconds for one in found if one.node == node)
        for node in sorted({one.node for one in found})
    }
    wrong = [
        f"{one.description}: {one.wrong or f'exit code {one.code}, {one.said}'}"
        for one in found
        if one.wrong or one.code not in _END_CODES
    ]
    late = [
        one.description
        for one in found
        if one.seconds > LONGEST_END.get(one.node, LONGEST_END_OF_OTHERS)
    ]
    times = ", ".join(f"{node} {seconds:.2f} s" for node, seconds in slowest.items())
    return Finding(
        key,
        f"signals at random moments at 2 x 30 Hz, {load}: {len(found)} ends",
        f"exit code 0 or 130, no traceback, within {LONGEST_END_OF_OTHERS:g} s "
        f"(recorder {LONGEST_END['recorder']:g} s, its bag whole)",
        "; ".join([f"{len(wrong)} otherwise", f"slowest: {times}", *wrong[:3], *late[:3]]),
        not wrong and not late,
    )


@contextlib.contextmanager
def _small_disk(folder: Path) -> Iterator[str]:
    """Mount a small disk in memory."""
    folder.mkdir()
    # Needs root.
    ran(["mount", "-t", "tmpfs", "-o", f"size={SMALL_DISK}", "tmpfs", str(folder)])
    try:
        yield "40 MB"
    finally:
        subprocess.run(["umount", str(folder)], check=False)


def _witness(domain: int, bag: Path) -> subprocess.Popen[bytes]:
    """Record the same graph on another disk."""
    words = ["--ros-args", "-r", "__node:=witness", "-p", f"bag:={bag}"]
    return subprocess.Popen(
        [sys.executable, "-m", "needle_bags.ros.recorder", *words],
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


CHECKS: tuple[Check, ...] = (
    full_rate,
    killed,
    disk_full,
    bag_format,
    *check_rerun.CHECKS,
    signals,
)
