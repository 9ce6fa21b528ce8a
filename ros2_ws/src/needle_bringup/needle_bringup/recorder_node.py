"""Records every topic of the graph, with what is needed to repeat the run, into one bag."""

from __future__ import annotations

import collections
import importlib
import json
import sys
import time
from pathlib import Path
from typing import Any, cast

import yaml
from rcl_interfaces.msg import ParameterEvent
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription

from needle_bringup.allocator import keep_freed_memory
from needle_bringup.bag_files import recover_hint
from needle_bringup.bag_metadata import BagTopic
from needle_bringup.conversions import IMAGE_TYPES, offered_qos, strictest_request
from needle_bringup.message_definitions import full_definition
from needle_bringup.message_loss import SequenceGaps
from needle_bringup.parameters import ParameterSnapshots
from needle_bringup.provenance import commit, distribution, versions
from needle_bringup.recorder_health import RecorderHealth
from needle_bringup.recorder_parameters import PARAMETERS_OF, RecorderParameters
from needle_bringup.recording import Recording
from needle_common.base_node import STEADY_CLOCK, DiagnosticsPublisher, run_node
from needle_common.cli import EXIT_DONE, EXIT_MISSED
from needle_common.diagnostics import Diagnostic, Level
from needle_common.end_request import EndRequest
from needle_common.errors import UserError
from needle_common.parameters import NodeParameters

HELP = """
recorder: records every topic of the graph into a bag (a rosbag2 directory with MCAP data).

Topics that appear later are recorded too, images included. The bag also carries the message
definitions, all nodes' parameters and their changes, the calibration file, versions and commit.
Ctrl-C ends the recording and completes the bag. Written out ten times a second: what a
crash or kill -9 leaves is made whole by `ros2 run needle_bringup recover BAG`.

  ros2 run needle_bringup recorder --ros-args -p bag:=bags/my_run

Subscribes to every topic of the graph; publishes /diagnostics: a warning when messages are lost or
the disk is nearly full. Down to `reserve` the recording ends, the bag is completed, and the node
stays to say so; the rest of the graph goes on.
Exit codes: 0 the bag is whole; 1 the disk refused data or was full; 2 bad parameters.
"""

GRAPH_PERIOD = 0.1
GRAPH_TIME = 0.05
# All that Fast DDS keeps for a reader by default: a burst while the graph is looked at must fit.
DEPTH = 5000
IMAGE_DEPTH = 60
# What the graph still sends when all nodes end together is waited for this long.
LAST_WORDS = 0.3
LAST_WORDS_LIMIT = 1.0
REPORT_PERIOD = 0.5
PARAMETER_EVENTS = "/parameter_events"


class _Topic:
    """One topic being recorded."""

    def __init__(self, name: str, type_name: str, message_class: type) -> None:
        self.name = name
        self.type_name = type_name
        self.message_class = message_class
        self.subscription: Subscription | None = None
        self.publishers = -1
        self.described = False
        self.lost_events = 0
        self.gaps = SequenceGaps()
        # Source stamps of the last messages: a subscription that replaces another may get some
        # of them again.
        self.recent: collections.deque[int] = collections.deque(maxlen=64)
        self.check_repeats_until = 0.0

    @property
    def lost(self) -> int:
        """Messages that did not arrive: as DDS tells, or as the numbers of the others show."""
        return max(self.lost_events, self.gaps.missing)


class Recorder(Node):
    """Subscribes to whatever the graph has and hands it to a `Recording`."""

    def __init__(self) -> None:
        super().__init__("recorder")
        self._settings = NodeParameters(self, RecorderParameters).values
        bag = self._settings.bag or time.strftime("bag_%Y_%m_%d-%H_%M_%S")
        calibration = _read_calibration(self._settings.calibration_file)
        self._diagnostics = DiagnosticsPublisher(self)
        self._topics: dict[str, _Topic] = {}
        self._refused: dict[str, str] = {}
        self._nodes: list[str] = []
        self._told: str = ""
        self.bag = Path(bag)
        self.recording = Recording(
            self.bag,
            distribution=distribution(),
            max_file_size=self._settings.max_file_size,
            compression=self._settings.compression,
            reserve=self._settings.reserve,
        )
        self._health = RecorderHealth(self.recording, self.bag)
        try:
            self._write_provenance(calibration)
            self._snapshots = ParameterSnapshots(self, self._take_parameters)
            self._poll_graph()
            self.create_timer(GRAPH_PERIOD, self._poll_graph, clock=STEADY_CLOCK)
            self.create_timer(REPORT_PERIOD, self.report, clock=STEADY_CLOCK)
        except BaseException:
            self.recording.close()
            raise
        self.get_logger().info(f"recording into {self.bag}")

    def _write_provenance(self, calibration: str) -> None:
        texts = {
            "run_info": self._settings.run_info,
            "versions": json.dumps(versions()),
            "commit": commit(),
            "calibration": calibration,
        }
        for key, text in texts.items():
            self.recording.set_custom_data(key, text)
        self.recording.add_record("needle_run", texts)
        if calibration:
            self.recording.add_file(
                "calibration.yaml", "application/yaml", calibration.encode(), time.time_ns()
            )

    def _take_parameters(self, node: str, values: dict[str, Any]) -> None:
        document = {node: {"ros__parameters": values}}
        self.recording.add_record("parameters", {"node": node, "yaml": yaml.safe_dump(document)})
        self._nodes.append(node)
        self._diagnostics.set(PARAMETERS_OF, Diagnostic(Level.OK, ", ".join(self._nodes)))

    def _take_parameter_event(self, data: bytes) -> None:
        changes = self._snapshots.take_event(deserialize_message(data, ParameterEvent))
        for change in changes:
            record = {key: yaml.safe_dump(value).split("\n")[0] for key, value in change.items()}
            self.recording.add_record("parameter_change", record)
        if changes:
            text = yaml.safe_dump(self._snapshots.changes)
            self.recording.set_custom_data("parameter_changes", text)

    def _poll_graph(self) -> None:
        if self.recording.error is not None:
            self._leave()
            return
        until = time.monotonic() + GRAPH_TIME
        for name, types in self.get_topic_names_and_types():
            # What waits on the topics that are recorded comes first; the rest at the next poll.
            if time.monotonic() > until:
                return
            topic = self._topics.get(name)
            if topic is None:
                topic = self._new_topic(name, types)
            if topic is not None:
                self._subscribe(topic)
        self._snapshots.poll()

    def _new_topic(self, name: str, types: list[str]) -> _Topic | None:
        if len(types) > 1:
            self._refuse(name, f"{name} has several types: {', '.join(types)}")
        if name in self._refused:
            return None
        try:
            full_definition(types[0])
            package, kind, short = types[0].split("/")
            message_class = getattr(importlib.import_module(f"{package}.{kind}"), short)
        except (UserError, ImportError, AttributeError) as error:
            self._refuse(name, f"{name} is not recorded: {error}")
            return None
        topic = _Topic(name, types[0], message_class)
        self._topics[name] = topic
        return topic

    def _refuse(self, name: str, why: str) -> None:
        if name not in self._refused:
            self._refused[name] = why
            self.get_logger().warning(why)

    def _subscribe(self, topic: _Topic) -> None:
        publishers = self.count_publishers(topic.name)
        if publishers == topic.publishers:
            return
        offers = self.get_publishers_info_by_topic(topic.name)
        if len(offers) != publishers:
            return  # the graph is changing under us: look again at the next poll
        topic.publishers = publishers
        topic.gaps.forget()
        if topic.subscription is not None and not offers:
            return
        qos = strictest_request(offers, IMAGE_DEPTH if topic.type_name in IMAGE_TYPES else DEPTH)
        before = topic.subscription
        if before is not None:
            now = before.qos_profile
            if (now.reliability, now.durability) == (qos.reliability, qos.durability):
                return
            topic.check_repeats_until = time.monotonic() + 2.0

        def count_lost(event: Any) -> None:
            topic.lost_events = event.total_count

        topic.subscription = self.create_subscription(
            topic.message_class,
            topic.name,
            lambda data, info: self._record_all(topic, data, info),
            qos,
            event_callbacks=SubscriptionEventCallbacks(message_lost=count_lost),
            raw=True,
        )
        if before is not None:
            self.destroy_subscription(before)

    def _record_all(self, topic: _Topic, data: bytes, info: dict[str, int]) -> None:
        """Take a message and all that wait behind it: the executor's round costs more than they."""
        self._record(topic, data, info)
        if topic.subscription is None:
            return
        handle = topic.subscription.handle
        with handle:
            for _ in range(DEPTH):
                taken = handle.take_message(topic.message_class, True)
                if taken is None:
                    return
                self._record(topic, *taken)

    def _record(self, topic: _Topic, data: bytes, info: dict[str, int]) -> None:
        sent = info["source_timestamp"]
        if sent in topic.recent and time.monotonic() < topic.check_repeats_until:
            return
        topic.recent.append(sent)
        if not topic.described:
            self._describe(topic)
        number = info["publication_sequence_number"] or 0
        if number and topic.publishers == 1:
            topic.gaps.take(number)
        received = info["received_timestamp"] or time.time_ns()
        self.recording.append(topic.name, data, received, sent or received, number)
        if topic.name == PARAMETER_EVENTS:
            self._take_parameter_event(data)

    def _describe(self, topic: _Topic) -> None:
        topic.described = True
        offers = self.get_publishers_info_by_topic(topic.name)
        known = offers or self.get_subscriptions_info_by_topic(topic.name)
        self.recording.add_topic(
            BagTopic(
                name=topic.name,
                type_name=topic.type_name,
                definition=full_definition(topic.type_name),
                type_hash=str(known[0].topic_type_hash) if known else "",
                offered_qos=tuple(offered_qos(offer) for offer in offers),
            )
        )

    def _leave(self) -> None:
        """Stop listening, once the recording has ended before its time."""
        for topic in self._topics.values():
            if topic.subscription is not None:
                self.destroy_subscription(topic.subscription)
                topic.subscription = None

    def report(self) -> None:
        """Publish the recording's health."""
        recording = self.recording
        lost = self._lost()
        values = {
            "bag": str(self.bag),
            "topics": str(len(self._topics)),
            "messages": str(recording.messages_received),
            "messages_waiting": str(recording.messages_waiting),
            "messages_lost": str(sum(lost.values())),
            "size_bytes": str(recording.bytes_received),
        }
        level, message = self._health.look(REPORT_PERIOD, lost, list(self._refused.values()))
        self._diagnostics.set("bag", Diagnostic(level, message, values))
        # Once for each kind of trouble: the figures at the end of a message change.
        kind = message.partition(":")[0]
        if level is Level.OK or kind == self._told:
            return
        self._told = kind
        if level is Level.ERROR:
            self.get_logger().error(message)
        else:
            self.get_logger().warning(message)

    def _lost(self) -> dict[str, int]:
        """Return how many messages of which topic are not in the bag."""
        lost = {name: topic.lost for name, topic in self._topics.items() if topic.lost}
        for name, count in list(self.recording.dropped.items()):
            lost[name] = lost.get(name, 0) + count
        return lost

    def finish(self) -> int:
        """Complete the bag; return the exit code and say one line about it."""
        for topic in self._topics.values():
            if not topic.described:
                self._describe(topic)
        parameters = yaml.safe_dump(self._snapshots.document())
        self.recording.set_custom_data("parameters", parameters)
        self.recording.add_file(
            "parameters.yaml", "application/yaml", parameters.encode(), time.time_ns()
        )
        lost = self._lost()
        if lost:
            self.recording.set_custom_data("messages_lost", json.dumps(lost))
        self.recording.close()
        count = self.recording.messages_received
        lost = self._lost()
        if self.recording.error is not None:
            state = (
                "the bag is whole up to there"
                if self.recording.is_whole
                else recover_hint(self.bag)
            )
            print(f"error: recording ended: {self.recording.error}; {state}", file=sys.stderr)
        else:
            print(f"recorded {count} messages of {len(self._topics)} topics into {self.bag}")
        if lost:
            print(f"warning: messages lost: {json.dumps(lost)}", file=sys.stderr)
        return EXIT_DONE if self.recording.error is None else EXIT_MISSED


def _read_calibration(path: str) -> str:
    if not path:
        return ""
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"calibration_file: cannot read {path}: {error}") from error


def main(args: list[str] | None = None) -> int:
    """Run the recorder; returns the exit code."""
    stop = EndRequest()
    keep_freed_memory()

    def spin(node: Node) -> int:
        recorder = cast(Recorder, node)
        executor = SingleThreadedExecutor()
        executor.add_node(recorder)
        try:
            while not stop.wanted:
                executor.spin_once(timeout_sec=0.1)
            limit = time.monotonic() + LAST_WORDS_LIMIT
            end = time.monotonic() + LAST_WORDS
            while time.monotonic() < min(end, limit):
                before = recorder.recording.messages_received
                executor.spin_once(timeout_sec=0.05)
                if recorder.recording.messages_received > before:
                    end = time.monotonic() + LAST_WORDS
            return recorder.finish()
        finally:
            recorder.recording.close()

    return run_node(
        Recorder,
        help_text=HELP,
        parameters=RecorderParameters,
        args=args,
        spin=spin,
        signal_handlers=SignalHandlerOptions.NO,
    )


if __name__ == "__main__":
    sys.exit(main())
