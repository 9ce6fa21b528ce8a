"""The player in a played graph: topics, their names and times, and the protection of a rig."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.interfaces import Qos, QosDurability, QosReliability
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Joy
from std_msgs.msg import Bool, Int32, String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from made_up_run import STORE
from needle_bags.format.bag_metadata import USUAL_QOS
from needle_bags.format.bag_writer import BagWriter
from needle_bags.format.message_definitions import full_definition
from needle_bags.ros import player as node
from needle_core.files.bag_topic import BagTopic

from .played_graph import PlayedGraph, type_name

START = 1_700_000_000_000_000_000
KEPT = USUAL_QOS._replace(durability=QosDurability.TRANSIENT_LOCAL)
UNSURE = USUAL_QOS._replace(reliability=QosReliability.BEST_EFFORT)
GUARDED: dict[str, type] = {
    "/device/joint_trajectory": JointTrajectory,
    "/device/hold": Joy,
    "/device/estop": Bool,
    "/target_plane": PoseStamped,
}
OFFERS: dict[str, tuple[type, Qos]] = {
    "/plane": (String, KEPT),
    "/numbered": (Int32, USUAL_QOS),
    "/noisy": (Int32, UNSURE),
    "/clock": (Clock, USUAL_QOS),
    **{topic: (kind, USUAL_QOS) for topic, kind in GUARDED.items()},
}
# Topics that cannot be played here: another distribution's definition, an unknown type.
OTHERWISE = {"/old": "std_msgs/msg/Header", "/odd": "no_msgs/msg/Such"}
COUNT = 20


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Bag with twenty messages per topic, 1 s apart, and one latched message at the start."""
    path = tmp_path_factory.mktemp("player") / "bag"
    writer = BagWriter(path)
    numbers = {}
    for name, (kind, qos) in OFFERS.items():
        label = type_name(kind)
        topic = BagTopic(name, label, full_definition(label), STORE.hash_rihs01(label), (qos,))
        numbers[name] = writer.add_topic(topic)
    for name, label in OTHERWISE.items():
        unknown = writer.add_topic(BagTopic(name, label, "uint32 seq\n"))
        writer.write(unknown, bytes([0, 1, 0, 0, 0, 0, 0, 0]), START, START)
    for second in range(COUNT):
        for name, (kind, _) in OFFERS.items():
            if name != "/plane" or not second:
                message = Int32(data=second) if kind is Int32 else kind()
                time = START + second * 10**9
                writer.write(numbers[name], serialize_message(message), time, time)
    writer.close()
    return path


class Scene(PlayedGraph):
    """A player and its graph."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, bag: Path) -> None:
        super().__init__(monkeypatch, node)
        self.bag = bag
        self.host(monkeypatch, node)

    def play(self, options: str = "") -> int:
        return node.main(["player", str(self.bag), *options.split()])

    def change(self, **values: float) -> None:
        self.set_parameters([Parameter(name, value=value) for name, value in values.items()])

    def pause(self, paused: bool) -> str:
        answer = self.services["~/pause"](SetBool.Request(data=paused), SetBool.Response())
        return str(answer.message)

    def when(self, number: int, act: Callable[[], Any]) -> None:
        """Run an action once after a number was played."""

        def look() -> None:
            if number in self.numbers("/numbered"):
                act()
            else:
                self.when(number, act)

        self.at(0.0, look)

    def numbers(self, topic: str) -> list[int]:
        return [deserialize_message(data, Int32).data for data in self.published[topic]]

    def offered(self) -> set[str]:
        return {one.topic_name for one in self.publishers} - {"/diagnostics"}


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch, bag: Path) -> Scene:
    return Scene(monkeypatch, bag)


def test_topics_that_control_a_rig_are_not_played(
    scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    begin = scene.now
    assert scene.play() == 0
    assert f"played {1 + 7 * COUNT} messages" in capsys.readouterr().out
    assert scene.now - begin == pytest.approx(node.DISCOVERY + COUNT - 1, abs=0.2)
    assert scene.numbers("/numbered") == scene.numbers("/noisy") == list(range(COUNT))
    for topic in GUARDED:
        assert topic not in scene.published
        assert len(scene.published[f"/replay{topic}"]) == COUNT
    assert not scene.offered() & GUARDED.keys()
    qos = {one.topic_name: one.qos for one in scene.publishers}
    assert qos["/plane"].durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert qos["/noisy"].reliability == ReliabilityPolicy.BEST_EFFORT
    old, odd = scene.logged
    assert "/old is not played: std_msgs/msg/Header has another definition" in old
    assert "/odd is not played: the definition of no_msgs/msg/Such is not installed" in odd


def test_part_of_a_bag_under_another_name_at_another_rate(scene: Scene) -> None:
    begin = scene.now
    scene.remaps = {"/numbered": "/other"}
    assert scene.play("--start 2 --end 7 --rate 0.5 --topics numbered --clock 10") == 0
    assert scene.numbers("/other") == list(range(2, 8))
    assert scene.offered() == {"/other", "/clock"}
    assert scene.now - begin == pytest.approx(node.DISCOVERY + 10.0, abs=0.2)
    # /clock has the recorded time, at 10 Hz of wall time.
    stamps = [message.clock.sec for message in scene.published["/clock"]]
    assert 80 < len(stamps) <= 101
    assert stamps[-1] - START // 10**9 == pytest.approx(7, abs=1)


def test_latched_messages_are_available_while_paused_and_loops_repeat(scene: Scene) -> None:
    def begin() -> None:
        # The latched message was recorded before --start, but late subscribers still receive it.
        assert len(scene.published["/plane"]) == 1
        assert scene.published["/numbered"] == []
        assert scene.pause(False) == "playing"

    def stop() -> None:
        scene.end.requested = True

    scene.at(9.0, begin)
    scene.at(9.0 + 2.5 * (COUNT - 5), stop)
    assert scene.play("--paused --loop --start 5") == 0
    published = scene.numbers("/numbered")
    assert published[: 2 * COUNT - 9] == [*range(5, COUNT), *range(5, COUNT), 5][: 2 * COUNT - 9]
    assert len(published) > 2 * COUNT - 10


def test_seeking_pausing_and_another_rate_while_it_plays(scene: Scene) -> None:
    scene.when(0, lambda: scene.change(seek=15.0))
    scene.when(15, lambda: scene.change(seek=4.0))
    scene.when(4, lambda: scene.change(seek=4.0))
    scene.when(5, lambda: scene.change(seek=11.0))
    # Bag time stands still during the pause at 11.
    scene.when(11, lambda: scene.pause(True))
    scene.when(11, lambda: scene.at(10.0, lambda: scene.pause(False)))
    scene.when(12, lambda: scene.change(rate=1.1))
    assert scene.play("--regex ^/n|plane --exclude-regex noisy") == 0
    assert scene.numbers("/numbered") == [0, 15, 4, 4, 5, *range(11, COUNT)]
    assert scene.offered() == {"/numbered", "/plane", "/replay/target_plane"}
    # Each jump republishes the latched message for new subscribers.
    assert len(scene.published["/plane"]) == 1 + 4


def test_on_a_graph_with_a_rig_everything_is_played_under_replay(scene: Scene) -> None:
    scene.at(1.5, lambda: scene.offer("/device/status", DiagnosticStatus, node="device_driver"))
    assert scene.play("--clock") == 0
    assert any("playing under /replay" in line for line in scene.logged)
    assert all(topic.startswith("/replay/") for topic in scene.offered())
    assert scene.numbers("/replay/numbered") == list(range(COUNT))
    assert not scene.published.keys() - {"/diagnostics"} - scene.offered()


def test_a_rig_that_appears_ends_the_playback(
    scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    # A replayed device status does not count as a rig.
    scene.offer("/replay/device/status", DiagnosticStatus, node="other_player")
    topic = "/bench/device/status"
    scene.when(3, lambda: scene.offer(topic, DiagnosticStatus, node="device_driver"))
    assert scene.play() == 1
    assert f"device_driver publishes {topic}" in capsys.readouterr().err
    assert scene.numbers("/numbered") == [0, 1, 2, 3]


def test_a_ros_remapping_cannot_reach_a_rig(
    scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    for played, remapped in (
        ("/replay/device/hold", "/device/hold"),
        ("/replay/device/hold", "/elsewhere"),
        ("/numbered", "/device/estop"),
    ):
        scene.remaps = {played: remapped}
        assert scene.play() == 2
        assert f"as {remapped}: a rig would execute it" in capsys.readouterr().err
        assert scene.published.keys() <= {"/diagnostics"}


def test_the_player_waits_for_existing_subscribers(scene: Scene) -> None:
    begun: list[float] = []
    scene.request("/numbered", Int32)
    scene.unmatched.add("/numbered")
    end, begin = node.DISCOVERY + 0.8 * node.MATCHING, scene.now
    scene.at(end, scene.unmatched.clear)
    scene.when(0, lambda: begun.append(scene.now - begin))
    assert scene.play("--topics numbered") == 0
    assert begun == [pytest.approx(end, abs=0.2)]


def test_bags_without_the_chosen_messages_are_refused(
    scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    for options, words in {
        "--topics nonsense": "/nonsense is not in",
        "--start 30": "--start 30 s",
        "--regex (": "is not a regular expression",
        "--regex nonsense": "no topic is chosen; it has /plane",
        "--topics odd": "none of its topics can be played",
    }.items():
        assert scene.play(options) == 2
        assert words in capsys.readouterr().err
