from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import ParameterEvent
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import Joy
from std_msgs.msg import Int32, String
from std_srvs.srv import Trigger

from .recorder_process import PATIENCE, STORE, Source, end, numbers, start


def test_nothing_is_lost(domain: int, source: Source, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    calibration = tmp_path / "calibration.yaml"
    calibration.write_text("phantom: {}\n")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    hold = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    state = source.publisher(String, "state", latched)
    state.publish(String(data="before the recorder came"))
    numbered, joy = source.publisher(Int32, "numbered", 2000), source.publisher(Joy, "hold", hold)
    process = start(
        domain, f"bag:={bag}", f"calibration_file:={calibration}", "run_info:='seed: 4'"
    )
    source.wait_matched(state, numbered, joy)
    for number in range(2000):
        numbered.publish(Int32(data=number))
    assert numbered.wait_for_all_acked(Duration(seconds=PATIENCE))
    joy.publish(Joy(buttons=[1]))
    late = source.publisher(Int32, "rig/late")
    source.wait_matched(late)
    for number in range(50):
        late.publish(Int32(data=number))
    # The recorder's questions about parameters need this node to spin until they are answered.
    data = bag / "bag_0.mcap"
    source.wait(lambda: b"gain: 1.5" in data.read_bytes(), "the parameters to be recorded")
    code, printed, errors = end(process)
    assert code == 0, errors
    assert f"into {bag}" in printed
    assert numbers(bag, "/numbered") == list(range(2000))
    assert numbers(bag, "/rig/late") == list(range(50))
    with Reader(bag) as reader:
        topics = {c.topic: c for c in reader.connections}
        counts = {name: c.msgcount for name, c in topics.items()}
        assert {"/rosout", "/parameter_events", "/diagnostics"} <= set(counts)
        assert (counts["/state"], counts["/hold"]) == (1, 1)
        for connection in topics.values():
            assert connection.digest == STORE.hash_rihs01(connection.msgtype)
        (offered,) = topics["/state"].ext.offered_qos_profiles  # type: ignore[union-attr]
        assert offered.durability is QosDurability.TRANSIENT_LOCAL
        (offered,) = topics["/hold"].ext.offered_qos_profiles  # type: ignore[union-attr]
        assert offered.reliability is QosReliability.BEST_EFFORT
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())
    custom = metadata["rosbag2_bagfile_information"]["custom_data"]
    assert custom["calibration"] == "phantom: {}\n"
    assert custom["run_info"] == "seed: 4"
    assert yaml.safe_load(custom["parameters"])["/source"]["ros__parameters"]["gain"] == 1.5


def test_a_disk_that_fills_ends_the_recording_and_nothing_else(
    domain: int, source: Source, tmp_path: Path
) -> None:
    """The kernel's limit on file sizes stands in for the disk."""
    bag = tmp_path / "bag"
    health: list[DiagnosticStatus] = []
    source.node.create_subscription(
        DiagnosticArray, "/diagnostics", lambda m: health.extend(m.status), 10
    )
    numbered = source.publisher(Int32, "numbered", 1000)
    texts = source.publisher(String, "texts", 1000)
    process = start(domain, f"bag:={bag}", largest_file=300_000)
    source.wait_matched(numbered, texts)
    sent = 0

    def refused() -> bool:
        nonlocal sent
        numbered.publish(Int32(data=sent))
        texts.publish(String(data="x" * 5000))
        sent += 1
        return any(status.level == DiagnosticStatus.ERROR for status in health)

    source.wait(refused, "the reason in /diagnostics")
    last = health[-1].message
    assert f"cannot write {bag}/bag_0.mcap: File too large" in last
    assert process.poll() is None
    code, _, errors = end(process)
    assert code == 1
    assert "the bag is whole up to there" in errors
    assert "messages lost" in errors
    kept = numbers(bag, "/numbered")
    assert 20 < len(kept) < sent
    assert kept == list(range(len(kept)))
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())
    custom = metadata["rosbag2_bagfile_information"]["custom_data"]
    assert "File too large" in custom["recording_ended"]
    assert json.loads(custom["messages_lost"])["/texts"] > 0


def test_split_compressed_and_parameters_that_change(
    domain: int, source: Source, tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    texts = source.publisher(String, "texts", 1000)
    numbered = source.publisher(Int32, "numbered", 1000)
    process = start(domain, f"bag:={bag}", "max_file_size:=100000", "compression:=zstd")
    source.wait_matched(texts, numbered)
    for number in range(100):
        texts.publish(String(data="x" * 5000))
        numbered.publish(Int32(data=number))
    assert texts.wait_for_all_acked(Duration(seconds=PATIENCE))

    def in_bag(text: bytes) -> bool:
        return any(text in file.read_bytes() for file in bag.glob("*.mcap"))

    source.wait(lambda: in_bag(b"gain: 1.5"), "the parameters to be recorded")
    source.node.set_parameters([Parameter("gain", value=2.5)])
    source.wait(lambda: in_bag(b"parameter_change"), "the change to be recorded")
    assert end(process)[0] == 0
    assert len(list(bag.glob("*.mcap"))) >= 5
    assert sum(file.stat().st_size for file in bag.glob("*.mcap")) < 300_000
    assert numbers(bag, "/numbered") == list(range(100))
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())
    custom = metadata["rosbag2_bagfile_information"]["custom_data"]
    assert yaml.safe_load(custom["parameters"])["/source"]["ros__parameters"]["gain"] == 1.5
    (change,) = yaml.safe_load(custom["parameter_changes"])
    assert (change["node"], change["name"], change["value"]) == ("/source", "gain", 2.5)


class Health:
    """What the recorder says of itself in /diagnostics."""

    def __init__(self, source: Source) -> None:
        self.parts: dict[str, DiagnosticStatus] = {}
        source.node.create_subscription(DiagnosticArray, "/diagnostics", self._take, 10)

    def _take(self, message: DiagnosticArray) -> None:
        self.parts.update({status.name: status for status in message.status})

    def value(self, part: str, key: str) -> str:
        status = self.parts.get(f"recorder: {part}", DiagnosticStatus())
        return next((pair.value for pair in status.values if pair.key == key), "")


def test_what_cannot_be_understood_is_told_and_recorded_and_ends_nothing(
    domain: int, source: Source, tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    health = Health(source)
    events = source.publisher(ParameterEvent, "/parameter_events")
    process = start(domain, f"bag:={bag}")
    source.wait_matched(events)
    # CDR that says to be longer than it is, and what is no CDR (DDS sends multiples of four).
    malformed = (b"\0\1\0\0" + bytes(8) + b"\xff\xff\xff\x7fmore", b"\xff" * 8)
    for data in malformed:
        events.publish(data)
    source.wait(lambda: health.value("input", "/parameter_events") == "2", "both to be counted")
    said = health.parts["recorder: input"]
    assert said.level == DiagnosticStatus.WARN
    assert said.message.startswith("not understood: /parameter_events (")
    # It still listens to what is right.
    source.wait(lambda: b"gain: 1.5" in (bag / "bag_0.mcap").read_bytes(), "the parameters")
    source.node.set_parameters([Parameter("gain", value=2.5)])
    source.wait(lambda: b"parameter_change" in (bag / "bag_0.mcap").read_bytes(), "the change")
    code, _, errors = end(process)
    assert code == 0
    assert "Traceback" not in errors
    with AnyReader([bag]) as reader:
        recorded = [d for c, _, d in reader.messages() if c.topic == "/parameter_events"]
    assert set(malformed) <= set(recorded)


def test_pictures_are_left_out_and_topics_chosen(
    domain: int, source: Source, tmp_path: Path
) -> None:
    topics = ("tracker/annotated_image", "rig/live_view/path", "rig/one", "rig/two", "other")
    publishers = [source.publisher(Int32, name) for name in topics]
    every = start(domain, f"bag:={tmp_path}/every")
    some = start(
        domain,
        f"bag:={tmp_path}/some",
        "topics:=[tracker/annotated_image]",
        "regex:=^/rig/",
        "exclude_regex:=two",
        "__node:=second",
    )
    source.wait(
        lambda: [p.get_subscription_count() for p in publishers] == [1, 1, 2, 1, 1],
        "both recorders",
    )
    for publisher in publishers:
        publisher.publish(Int32(data=1))
        assert publisher.wait_for_all_acked(Duration(seconds=PATIENCE))
    assert [end(process)[0] for process in (every, some)] == [0, 0]
    recorded = [
        {name for name in topics if numbers(tmp_path / bag, f"/{name}")}
        for bag in ("every", "some")
    ]
    assert recorded == [set(topics[2:]), set(topics[:3])]


def test_snapshots_when_asked_and_on_a_fault(domain: int, source: Source, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    health = Health(source)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    plane, numbered = source.publisher(Int32, "plane", latched), source.publisher(Int32, "numbered")
    status = source.publisher(DiagnosticStatus, "bench/device/status", latched)
    process = start(domain, f"bag:={bag}", "snapshot_seconds:=600.0", "snapshot_size:=1000000")
    source.wait_matched(plane, numbered, status)
    asked = source.node.create_client(Trigger, "/recorder/snapshot")
    source.wait(asked.service_is_ready, "the service")

    def messages() -> int:
        return int(health.value("bag", "messages") or 0)

    def say(state: str) -> None:
        status.publish(DiagnosticStatus(values=[KeyValue(key="state", value=state)]))

    plane.publish(Int32(data=7))
    say("HOLDING")
    # More than fits: the first go, the latched ones stay.
    for number in range(3000):
        numbered.publish(Int32(data=number))
    assert numbered.wait_for_all_acked(Duration(seconds=PATIENCE))
    source.wait(lambda: float(health.value("bag", "in_memory_bytes") or 0) > 9e5, "all to be there")
    assert messages() == 0
    answer = asked.call_async(Trigger.Request())
    source.wait(answer.done, "the answer")
    assert answer.result().success
    assert "asked for" in answer.result().message
    source.wait(messages, "the snapshot")
    before = messages()
    assert before < 1300
    numbered.publish(Int32(data=-1))
    status.publish(b"\xff\xff\xff")
    say("FAULT")
    source.wait(lambda: messages() > before, "the snapshot of the fault")
    numbered.publish(Int32(data=-2))
    assert end(process)[0] == 0
    kept = numbers(bag, "/numbered")
    assert kept[-2:] == [2999, -1]
    assert kept[0] > 1000
    assert kept[:-1] == list(range(kept[0], 3000))
    assert numbers(bag, "/plane") == [7]
    with Reader(bag) as reader:
        assert {c.topic: c.msgcount for c in reader.connections}["/bench/device/status"] == 3


def test_a_signal_during_start_up_leaves_a_whole_bag_or_none(domain: int, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    process = start(domain, f"bag:={bag}")
    end_of_patience = time.monotonic() + PATIENCE
    while not bag.exists():
        assert time.monotonic() < end_of_patience
        time.sleep(0.001)
    assert end(process)[0] == 0
    with Reader(bag) as reader:
        assert reader.ros_distro == "jazzy"


@pytest.mark.parametrize(
    ("parameter", "words"),
    [
        ("bag:={here}", "holds a bag already"),
        ("bagg:=x", "did you mean 'bag'"),
        ("calibration_file:={here}/none.yaml", "cannot be read"),
        ("regex:='('", "is not a regular expression"),
        ("topics:=[1, 2]", "are not names"),
        ("topics:=5", "topics = 5"),
    ],
)
def test_bad_parameters_are_one_line_and_exit_2(
    domain: int, tmp_path: Path, parameter: str, words: str
) -> None:
    (tmp_path / "metadata.yaml").write_text("{}")
    process = start(domain, parameter.format(here=tmp_path))
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 2
    assert words in errors
    assert errors.count("\n") == 1
