"""The `recorder` node: records every topic of the graph, parameters and versions into a bag."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any, cast

import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import ParameterEvent
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from std_srvs.srv import Trigger

from needle_bags.format.bag_writer import COMPRESSIONS
from needle_bags.format.topic_choice import TopicChoice
from needle_bags.recording.provenance import commit, distribution, versions
from needle_bags.recording.recent_messages import RecentMessages
from needle_bags.recording.recorder_health import RecorderHealth
from needle_bags.recording.recording import (
    RESERVE,
    Received,
    open_recording,
    reuse_freed_memory,
)
from needle_bags.ros.graph_topics import GraphTopics
from needle_bags.ros.parameter_snapshots import ParameterSnapshots
from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED
from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_core.files.bag_path import recover_hint
from needle_core.files.bag_topic import BagTopic
from needle_core.files.mcap_file import RUN_RECORD
from needle_core.process.shutdown import ShutdownFlag
from needle_core.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher, WholeNode
from needle_core.ros.main import run_node
from needle_core.ros.parameters import NodeParameters
from needle_core.settings.parameter_fields import check_fields, fixed_parameter
from needle_core.settings.parameter_files import absolute_name

HELP = """
recorder: records every topic of the graph into a bag (a rosbag2 directory with MCAP data).

Also records images and topics that appear later, but not annotated images (`exclude_regex`). The
bag contains message definitions, the parameters of all nodes and their changes, versions and
commit. Ctrl-C ends the recording and completes the bag. Data are written ten times a second; after
a crash, kill -9 or a full disk, `ros2 run needle_bags recover BAG` completes the bag.

  ros2 run needle_bags recorder --ros-args -p bag:=bags/my_run
  ros2 run needle_bags recorder --ros-args -p topics:='[/needle/tip, /joint_states]'
  ros2 run needle_bags recorder --ros-args -p snapshot_seconds:=20.0

With `snapshot_seconds` the last seconds stay in memory. They are written on a call of the service
~/snapshot (std_srvs/Trigger), and a second after device/status reports FAULT or ESTOPPED. All
snapshots are in the same bag; each message is written once.

/diagnostics has a warning if messages are lost and if the disk is nearly full. When only `reserve`
is free, the recording ends and the bag is completed; the node continues to report this.
Exit codes: 0 the bag is complete; 1 the disk was full or a write failed; 2 invalid parameters, or
the bag cannot be created
"""

GRAPH_PERIOD = 0.1
# After the signal, record until no message arrives for DRAIN_QUIET, but at most DRAIN_LIMIT [s].
DRAIN_QUIET = 0.3
DRAIN_LIMIT = 1.0
REPORT_PERIOD = 0.5
# A snapshot also covers this time after the fault [s].
FAULT_DELAY = 1.0
PARAMETER_EVENTS = "/parameter_events"
# Diagnostics part that names the nodes whose parameters are in the bag.
PARAMETERS_OF = "parameters_of"
DEVICE_STATUS = "/device/status"
FAULTS = ("FAULT", "ESTOPPED")


@dataclasses.dataclass(frozen=True)
class RecorderParameters:
    """Parameters of the recorder."""

    bag: str = fixed_parameter(
        "", "-", "Directory of the bag; empty: a new time-stamped one in the working directory."
    )
    topics: tuple[str, ...] = fixed_parameter(
        (), "-", "Topics to record; with neither topics nor a regex, all topics.", texts=True
    )
    regex: str = fixed_parameter("", "-", "Also record topics whose name matches this expression.")
    exclude_regex: str = fixed_parameter(
        "/annotated_image$|/live_view/",
        "-",
        "Do not record topics whose name matches this expression, unless `topics` has them.",
    )
    snapshot_seconds: float = fixed_parameter(
        0.0,
        "s",
        "Keep the messages of this time, write them on request or on a fault; 0: write all.",
        0.0,
        3600.0,
    )
    snapshot_size: int = fixed_parameter(
        500_000_000,
        "B",
        "Maximum memory of the snapshot; with images it may be shorter than snapshot_seconds.",
        1_000_000,
        2**40,
    )
    run_info: str = fixed_parameter(
        "", "-", "Text about the run to store in the bag: YAML `key: value` lines or JSON."
    )
    max_file_size: int = fixed_parameter(
        4_000_000_000,
        "B",
        "Maximum bytes of messages per data file; 0: no limit.",
        lower=0,
    )
    compression: str = fixed_parameter(
        "none",
        "-",
        "Compression of the data; zstd needs a third of a core for noisy images.",
        choices=COMPRESSIONS,
    )
    reserve: int = fixed_parameter(
        RESERVE,
        "B",
        "Free disk space at which the recording ends; at most a tenth of the disk.",
        lower=0,
    )

    def __post_init__(self) -> None:
        """Check the fields."""
        check_fields(self)
        if not all(isinstance(name, str) for name in self.topics):
            raise UserError(f"topics = {list(self.topics)} are not names")
        _ = self.choice

    @property
    def choice(self) -> TopicChoice:
        """The topics to record."""
        return TopicChoice(tuple(map(absolute_name, self.topics)), self.regex, self.exclude_regex)

    @property
    def recent(self) -> RecentMessages | None:
        """Empty snapshot buffer; None if everything is written."""
        if not self.snapshot_seconds:
            return None
        return RecentMessages(self.snapshot_seconds, self.snapshot_size)


class Recorder(WholeNode):
    """Subscribes to all topics of the graph and passes their messages to a `Recording`."""

    def __init__(self) -> None:
        super().__init__("recorder")
        self._settings = NodeParameters(self, RecorderParameters).values
        bag = self._settings.bag or time.strftime("bag_%Y_%m_%d-%H_%M_%S")
        self._diagnostics = DiagnosticsPublisher(self)
        self._topics = GraphTopics(self, self._settings.choice, self._add_topic, self._receive)
        self._recent = self._settings.recent
        self._states: dict[str, str] = {}
        self._snapshot_due: tuple[float, str] | None = None
        self._nodes: list[str] = []
        self._last_warning = ""
        self.bag = Path(bag)
        self.recording = open_recording(
            self.bag,
            distribution=distribution(),
            max_file_size=self._settings.max_file_size,
            compression=self._settings.compression,
            reserve=self._settings.reserve,
        )
        self._health = RecorderHealth(self.recording, self.bag)
        try:
            self._write_provenance()
            self._snapshots = ParameterSnapshots(self, self._store_parameters)
            if self._recent is not None:
                self.create_service(Trigger, "~/snapshot", self._on_snapshot)
            self._poll_graph()
            self.create_timer(GRAPH_PERIOD, self._poll_graph, clock=STEADY_CLOCK)
            self.create_timer(REPORT_PERIOD, self.report, clock=STEADY_CLOCK)
        except BaseException:
            self.recording.close()
            raise
        self.get_logger().info(f"recording into {self.bag}")

    def _write_provenance(self) -> None:
        texts = {
            "run_info": self._settings.run_info,
            "versions": json.dumps(versions()),
            "commit": commit(),
        }
        for key, text in texts.items():
            self.recording.set_custom_data(key, text)
        self.recording.add_record(RUN_RECORD, texts)

    def _store_parameters(self, node: str, values: dict[str, Any]) -> None:
        document = {node: {"ros__parameters": values}}
        self.recording.add_record("parameters", {"node": node, "yaml": yaml.safe_dump(document)})
        self._nodes.append(node)
        self._diagnostics.set(PARAMETERS_OF, Diagnostic(Level.OK, ", ".join(self._nodes)))

    def _store_parameter_event(self, message: Received) -> None:
        changes = self._snapshots.apply_event(deserialize_message(message.data, ParameterEvent))
        for change in changes:
            record = {key: yaml.safe_dump(value).split("\n")[0] for key, value in change.items()}
            self.recording.add_record("parameter_change", record)

    def _poll_graph(self) -> None:
        if self.recording.error is not None:
            self._topics.unsubscribe()
        else:
            self._topics.poll()
            self._snapshots.poll()
            self.recording.flush_idle()

    def _add_topic(self, topic: BagTopic) -> None:
        self.recording.add_topic(topic)
        if self._recent is not None and topic.is_latched:
            self._recent.latch(topic.name)

    def _receive(self, message: Received) -> None:
        if self._recent is None:
            self.recording.append(message)
        else:
            self._recent.put(message)
            if message.topic.endswith(DEVICE_STATUS):
                self._check_device_status(message)
        if message.topic == PARAMETER_EVENTS:
            self._store_parameter_event(message)

    def _check_device_status(self, message: Received) -> None:
        status = deserialize_message(message.data, DiagnosticStatus)
        state = next((pair.value for pair in status.values if pair.key == "state"), "")
        if state in FAULTS and self._states.get(message.topic) != state:
            reason = f"{message.topic} reports {state}"
            self._snapshot_due = (time.monotonic() + FAULT_DELAY, reason)
        self._states[message.topic] = state

    def _on_snapshot(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = self._write_snapshot("asked for")
        response.success = self.recording.error is None
        return response

    def _write_snapshot(self, reason: str) -> str:
        """Queue the buffered messages; return a summary."""
        if self._recent is None:
            return ""
        self._snapshot_due = None
        seconds = self._recent.seconds
        messages = self._recent.drain()
        self.recording.append_all(messages)
        summary = f"{len(messages)} messages of the last {seconds:.1f} s into {self.bag}: {reason}"
        record = {"why": reason, "messages": str(len(messages)), "time_ns": str(time.time_ns())}
        self.recording.add_record("snapshot", record)
        self.get_logger().info(f"snapshot: {summary}")
        return summary

    def report(self) -> None:
        """Publish the health of the recording; write a snapshot if it is due."""
        if self._snapshot_due is not None and time.monotonic() >= self._snapshot_due[0]:
            self._write_snapshot(self._snapshot_due[1])
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
        if self._recent is not None:
            values["in_memory_s"] = f"{self._recent.seconds:.1f}"
            values["in_memory_bytes"] = str(self._recent.memory)
        refused = list(self._topics.refused.values())
        level, message = self._health.check(REPORT_PERIOD, lost, refused)
        self._diagnostics.set("bag", Diagnostic(level, message, values))
        # Log each kind of problem once; the numbers after the colon change.
        kind = message.partition(":")[0]
        if level is Level.OK or kind == self._last_warning:
            return
        self._last_warning = kind
        if level is Level.ERROR:
            self.get_logger().error(message)
        else:
            self.get_logger().warning(message)

    def _lost(self) -> dict[str, int]:
        """Return the number of messages missing from the bag, by topic."""
        lost = self._topics.lost
        for name, count in list(self.recording.dropped.items()):
            lost[name] = lost.get(name, 0) + count
        return lost

    def finish(self) -> int:
        """Complete the bag and print the result; return the exit code."""
        self._topics.describe_all()
        if self._snapshot_due is not None:
            self._write_snapshot(self._snapshot_due[1])
        if self._snapshots.changes:
            changes = yaml.safe_dump(self._snapshots.changes)
            self.recording.set_custom_data("parameter_changes", changes)
        parameters = yaml.safe_dump(self._snapshots.document())
        self.recording.set_custom_data("parameters", parameters)
        self.recording.close(self._topics.lost)
        count = self.recording.messages_received
        lost = self._lost()
        if self.recording.error is not None:
            whole = self.recording.is_whole
            state = "the bag is complete up to there" if whole else recover_hint(self.bag)
            print(f"error: recording ended: {self.recording.error}; {state}", file=sys.stderr)
        else:
            print(f"recorded {count} messages of {len(self._topics)} topics into {self.bag}")
        if lost:
            print(f"warning: messages lost: {json.dumps(lost)}", file=sys.stderr)
        return EXIT_DONE if self.recording.error is None else EXIT_MISSED


def main(args: list[str] | None = None) -> int:
    """Run the recorder; return the exit code."""
    reuse_freed_memory()

    def spin(node: Node, end: ShutdownFlag) -> int:
        recorder = cast(Recorder, node)
        executor = SingleThreadedExecutor()
        executor.add_node(recorder)
        try:
            while not end.requested:
                executor.spin_once(0.1)
            limit = time.monotonic() + DRAIN_LIMIT
            quiet = time.monotonic() + DRAIN_QUIET
            while time.monotonic() < min(quiet, limit):
                before = recorder.recording.messages_received
                executor.spin_once(0.05)
                if recorder.recording.messages_received > before:
                    quiet = time.monotonic() + DRAIN_QUIET
            return recorder.finish()
        finally:
            recorder.recording.close()

    return run_node(
        Recorder,
        help_text=HELP,
        parameters=RecorderParameters,
        args=args,
        spin=spin,
    )


if __name__ == "__main__":
    sys.exit(main())
