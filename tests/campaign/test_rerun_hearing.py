"""A controller that hears late decides otherwise, and its bag runs again as it did."""

from __future__ import annotations

import functools
import random
from collections import defaultdict, deque
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any

import pytest
from rosbags.typesys import Stores, get_typestore

from needle_analysis.rerun.comparison import FIELDS
from needle_analysis.ros import rerun
from needle_analysis.ros.controller_rerun import ControllerStage, step_ends
from needle_bags.format.bag_copy import BagCopy
from needle_bags.reading.bag_files import read_contents
from needle_bags.reading.bag_order import SentMessage, raw_as_sent
from needle_bags.reading.bag_reader import read_run
from needle_controller.controller_status import controller_status
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.heard_messages import HeardMessages

STORE = get_typestore(Stores.ROS2_JAZZY)
BAG = Path(__file__).resolve().parents[2] / "bags" / "regression"
TYPE = "diagnostic_msgs/msg/DiagnosticStatus"
PAIR = STORE.types["diagnostic_msgs/msg/KeyValue"]
STATUS = "/needle/controller_status"
MILLISECOND = 1_000_000
DELAYS = {
    "joint_states": 40,
    "needle/tip": 30,
    "needle/tip_pose": 30,
    "device/result": 15,
    "device/status": 15,
}
"""What the controller hears, and by how much late at most [ms]."""
HANGS, HANG = 6, 200 * MILLISECOND
ROOM = 10
OUTPUTS = {f"/{topic}" for topic in FIELDS if topic not in DELAYS}


@functools.cache
def settings() -> SteeringSettings:
    run = read_run(BAG)
    names = SteeringSettings.__dataclass_fields__
    known = {n: run.parameter("plane_controller", n) for n in names}
    values: dict[str, Any] = {
        n: tuple(v) if isinstance(v, list) else v for n, v in known.items() if v is not None
    }
    return SteeringSettings(**values)


@functools.cache
def ends() -> dict[int, Any]:
    return step_ends(BAG, "/")


@functools.cache
def recorded() -> tuple[list[SentMessage], int]:
    """What the controller did not send, and when it was started."""
    kept = read_contents(BAG).topics.keys() - OUTPUTS - {STATUS}
    messages = list(raw_as_sent(BAG, kept.__contains__, lambda _: False))
    statuses = raw_as_sent(BAG, STATUS.__eq__, lambda _: False)
    return messages, next(status.time for status in statuses if b"STEERING" in status.data)


class LateController:
    """Hears a bag's messages late, and writes what it does to a copy of the bag."""

    def __init__(self) -> None:
        self.stage = ControllerStage(settings(), "/plane_controller", ends())
        self.heard = HeardMessages()
        self.said: Any = None
        self.sent: list[tuple[int, str, bytes]] = []

    def hear(self, time: int, message: SentMessage) -> None:
        name = message.topic.removeprefix("/")
        self.heard.add(name, message.time)
        content = STORE.deserialize_cdr(message.data, message.type_name)
        for number, output in enumerate(self.stage.take(name, message, content)):
            self.sent.append((time + 10 * number, f"/{output.topic}", output.data))
        self.say(time + 100)

    def start(self, time: int) -> bool:
        """Start it, or return False: it has not heard yet that the device is ready."""
        reply, _ = self.stage._steering.on_start()
        self.say(time)
        return reply.success

    def say(self, time: int) -> None:
        status = controller_status(self.stage._steering, "best")
        if status == self.said and not self.heard.is_full:
            return
        self.said = status
        values = {**status.values, "heard": self.heard.take_text()}
        pairs = [PAIR(key=key, value=value) for key, value in values.items()]
        message = STORE.types[TYPE](0, "", "", "", pairs)
        data = bytes(STORE.serialize_cdr(message, TYPE))
        self.sent.append((time, STATUS, data))


def late_bag(folder: Path, source: random.Random) -> Path:
    """A copy of the committed bag, as if its controller had been slow and had hung at times."""
    contents = read_contents(BAG)
    copy = BagCopy(folder, contents.distribution, contents.custom_data)
    messages, start = recorded()
    controller = LateController()
    is_started = False
    for time, message in heard(messages, source):
        if time > start and not is_started:
            is_started = controller.start(time)
        controller.hear(time, message)
    everything = [(m.time, m.topic, m.data) for m in messages] + controller.sent
    for time, topic, data in sorted(everything, key=itemgetter(0)):
        copy.put(contents.topics[topic], data, time, time)
    copy.close()
    return folder


def heard(messages: list[SentMessage], source: random.Random) -> list[tuple[int, SentMessage]]:
    """When each was heard; what came while the controller hung and had no room never was."""
    begin, end = messages[0].time, messages[-1].time
    hangs = [source.randrange(begin, end) for _ in range(HANGS)]
    latest: dict[str, int] = defaultdict(int)
    waiting: dict[tuple[int, str], deque[tuple[int, SentMessage]]]
    waiting = defaultdict(lambda: deque(maxlen=ROOM))
    at_once: list[tuple[int, SentMessage]] = []
    for message in messages:
        topic = message.topic
        if topic.removeprefix("/") not in DELAYS:
            continue
        time = message.time + source.randrange(DELAYS[topic.removeprefix("/")] * MILLISECOND)
        ends = [hang + HANG for hang in hangs if hang <= time < hang + HANG]
        # A topic keeps its order.
        latest[topic] = max([time, latest[topic] + 1000, *ends])
        queue = waiting[max(ends), topic] if ends else at_once
        queue.append((latest[topic], message))
    return sorted(chain(at_once, *waiting.values()), key=itemgetter(0))


@pytest.mark.parametrize("seed", range(12))
def test_whatever_was_heard_late_or_not_the_bag_runs_again_as_it_did(
    tmp_path: Path, seed: int, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = late_bag(tmp_path / "late", random.Random(seed))
    assert read_contents(bag).counts["/needle/estimate"] > 0
    assert rerun.main([str(bag)]) == 0, capsys.readouterr().out
