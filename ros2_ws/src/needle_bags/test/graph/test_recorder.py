"""The recorder in a played graph: content of the bag, reports, and the end."""

from __future__ import annotations

import errno
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from mcap.writer import Writer
from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import Parameter
from rosbags.interfaces import QosReliability
from std_msgs.msg import Int32, String
from std_srvs.srv import Trigger

from needle_bags.format.bag_writer import BagWriter
from needle_bags.reading.bag_messages import read_contents, read_messages
from needle_bags.recording.recording import FreeSpace, Recording
from needle_bags.recording.worker import Job, RunJob
from needle_bags.recovery.bag_recovery import recover_bag
from needle_bags.ros import graph_topics, parameter_snapshots
from needle_bags.ros import recorder as node
from needle_bags.ros.recorder import RecorderParameters
from needle_core.errors import UserError

from .played_graph import BEST_EFFORT, LATCHED, PlayedGraph

EVENTS, STATUS = "/parameter_events", "/bench/device/status"


class AtOnce:
    """Worker that runs each job immediately."""

    waiting = 0

    def __init__(self, do: RunJob, end: Job) -> None:
        self._do, self._ends = do, [end]

    def put(self, job: Job) -> None:
        self._do(job)

    def finish(self) -> None:
        while self._ends:
            self._ends.pop()()


class Scene(PlayedGraph):
    """Recorder that starts and stops under control of the test."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
        super().__init__(monkeypatch, node, graph_topics, parameter_snapshots)
        self.bag = folder / "bag"

        def begin(bag: Path, *, reserve: int, **how: Any) -> Recording:
            writer, space = BagWriter(bag, **how), FreeSpace(bag, reserve)
            return Recording(writer, space, AtOnce, clock=lambda: self.now)

        monkeypatch.setattr(node, "open_recording", begin)
        monkeypatch.setattr(node, "commit", lambda: "0123abc")
        self._host = partial(self.host, monkeypatch, node)

    def record(self, act: Callable[[], None], **settings: Any) -> int:
        """Run the executable; call `act` between its start and the signal."""
        self._host(RecorderParameters(bag=str(self.bag), reserve=0, **settings))

        def act_and_end() -> None:
            act()
            self.end.requested = True

        self.at(0.3, act_and_end)
        return node.main()

    def health(self, part: str) -> DiagnosticStatus:
        """Return the last reported status of a part."""
        statuses = [s for message in self.published["/diagnostics"] for s in message.status]
        return [s for s in statuses if s.name == f"recorder: {part}"][-1]

    def numbers(self, topic: str) -> list[int]:
        return [message.data for _, _, message in read_messages(self.bag, topic.__eq__)]


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Scene:
    return Scene(monkeypatch, tmp_path)


def test_the_bag_has_all_messages_and_what_a_rerun_needs(
    scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    scene.parameters["/source"] = {"gain": 1.5}
    scene.offer("/state", String, LATCHED)
    scene.offer("/numbered", Int32)
    scene.offer("/tracker/annotated_image", Int32)
    scene.offer(EVENTS, ParameterEvent)
    file = scene.bag / "bag_0.mcap"

    def act() -> None:
        scene.answer_all()
        scene.run(0.1)
        scene.send("/state", String(data="once"))
        scene.send("/numbered", *(Int32(data=number) for number in range(200)))
        event = ParameterEvent(node="/source")
        event.changed_parameters = [Parameter("gain", value=2.5).to_parameter_msg()]
        scene.send(EVENTS, event)
        scene.offer("/rig/late", Int32, BEST_EFFORT)
        before = file.stat().st_size
        scene.run(0.1)
        # A kill now would lose nothing, although no message has followed.
        assert file.stat().st_size > before
        # Messages that arrive shortly after the signal are recorded, too.
        scene.at(0.1, lambda: scene.send("/rig/late", Int32(data=1)))
        scene.at(0.35, lambda: scene.send("/rig/late", Int32(data=2)))

    assert scene.record(act, run_info="seed: 4") == 0
    assert f"recorded 204 messages of 4 topics into {scene.bag}" in capsys.readouterr().out
    assert scene.numbers("/numbered") == list(range(200))
    assert scene.numbers("/rig/late") == [1, 2]
    contents = read_contents(scene.bag)
    assert contents.topics["/state"].is_latched
    (qos,) = contents.topics["/rig/late"].offered_qos
    assert qos.reliability is QosReliability.BEST_EFFORT
    custom = contents.custom_data
    assert custom["run_info"] == "seed: 4"
    assert yaml.safe_load(custom["parameters"])["/source"] == {"ros__parameters": {"gain": 1.5}}
    (change,) = yaml.safe_load(custom["parameter_changes"])
    assert (change["node"], change["name"], change["value"]) == ("/source", "gain", 2.5)
    data = file.read_bytes()
    assert all(text in data for text in (b"gain: 1.5", b"parameter_change", b"0123abc"))
    assert scene.health("parameters_of").message == "/recorder, /source"


def test_a_full_disk_ends_the_recording_and_not_the_node(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene.offer("/numbered", Int32)
    write, written = Writer.add_message, iter(range(6))

    def full_after_six(*given: Any) -> None:
        if next(written, None) is None:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(*given)

    monkeypatch.setattr(Writer, "add_message", full_after_six)

    def act() -> None:
        scene.send("/numbered", *(Int32(data=number) for number in range(5)))
        scene.now += 0.2
        # The first of these flushes all earlier ones; the second meets the full disk.
        scene.send("/numbered", *(Int32(data=number) for number in range(5, 9)))
        scene.run(0.5)
        # All subscriptions have ended.
        assert scene.subscriptions == []
        scene.run(0.5)

    assert scene.record(act) == 1
    status = scene.health("bag")
    assert status.level == DiagnosticStatus.ERROR
    assert f"cannot write {scene.bag}/bag_0.mcap: No space left on device" in status.message
    assert sum("recording ended" in line for line in scene.logged) == 1
    errors = capsys.readouterr().err
    assert f"`ros2 run needle_bags recover {scene.bag}`" in errors
    assert 'messages lost: {"/numbered": 3}' in errors
    monkeypatch.undo()
    recover_bag(scene.bag)
    assert scene.numbers("/numbered") == [0, 1, 2, 3, 4, 5]


def test_snapshots_on_request_and_a_second_after_a_fault(scene: Scene) -> None:
    scene.offer("/plane", Int32, LATCHED)
    scene.offer("/numbered", Int32)
    scene.offer(STATUS, DiagnosticStatus, LATCHED)
    answer = Trigger.Response()

    def publish_state(state: str) -> None:
        values = [KeyValue(key="state", value=state)]
        scene.send(STATUS, DiagnosticStatus(values=values))

    def act() -> None:
        scene.send("/plane", Int32(data=7))
        publish_state("HOLDING")
        # More than the limit: the oldest messages are dropped, latched ones stay.
        scene.send("/numbered", *(Int32(data=number) for number in range(1400)))
        scene.run(0.5)
        assert not int({p.key: p.value for p in scene.health("bag").values}["messages"])
        scene.services["~/snapshot"](Trigger.Request(), answer)
        scene.send("/numbered", Int32(data=-1))
        publish_state("FAULT")
        scene.run(0.9)
        scene.send("/numbered", Int32(data=-2))
        scene.run(0.5)
        # The same fault again causes no snapshot.
        scene.send("/numbered", Int32(data=-3))
        publish_state("FAULT")

    settings = {"snapshot_seconds": 600.0, "snapshot_size": 1_000_000}
    assert scene.record(act, **settings) == 0
    assert answer.success
    assert "asked for" in answer.message
    kept = scene.numbers("/numbered")
    assert kept[0] > 150
    assert kept == [*range(kept[0], 1400), -1, -2]
    assert scene.numbers("/plane") == [7]
    assert read_contents(scene.bag).counts[STATUS] == 2


def test_topic_selection_and_invalid_parameters() -> None:
    topics = ("/a/annotated_image", "/rig/live_view/path", "/rig/one", "/rig/two", "/other")
    named: Any = {"topics": ("a/annotated_image",), "regex": "^/rig/", "exclude_regex": "two|view"}
    for settings, chosen in (({}, topics[2:]), (named, (topics[0], topics[2]))):
        choice = RecorderParameters(**settings).choice
        assert tuple(topic for topic in topics if topic in choice) == chosen
    refused: Any = {"regex": "(", "topics": (1, 2), "compression": "lz4", "snapshot_size": 10}
    for name, value in refused.items():
        with pytest.raises(UserError, match=r"regular expression|names|lz4|= 10"):
            RecorderParameters(**{name: value})
