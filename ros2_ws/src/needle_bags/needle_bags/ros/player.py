"""Plays a bag without affecting a rig."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Container, Iterator
from functools import partial
from typing import Any, Final, cast

from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool
from tqdm import tqdm

from needle_bags.format.message_definitions import message_class, unplayable
from needle_bags.player.playback import PlaybackClock
from needle_bags.player.player_options import (
    MAX_RATE,
    MIN_RATE,
    PlayerOptions,
    parse_options,
    require_fits,
)
from needle_bags.player.replay_names import REPLAY, is_guarded, marks_a_rig, played_name
from needle_bags.reading.bag_messages import read_contents
from needle_bags.ros.conversions import recorded_offer
from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, run_command
from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_core.files.bag_directory import BagDirectory, SentMessage
from needle_core.files.bag_topic import BagTopic
from needle_core.message_types import rclpy_types
from needle_core.process.shutdown import ShutdownFlag
from needle_core.ros.base_node import RELIABLE, DiagnosticsPublisher, WholeNode
from needle_core.ros.main import run_node
from needle_core.ros.parameters import NodeParameters
from needle_core.settings.parameter_fields import check_fields, parameter

CLOCK: Final = "/clock"
# Time to discover a rig before the first message, further time for subscribers to discover the
# publishers, and period of checking the graph during playback [s].
DISCOVERY: Final = 2.0
MATCHING: Final = 3.0
CHECK_PERIOD: Final = 0.1
ACKNOWLEDGED: Final = 5.0
MAX_TURN: Final = 0.02  # maximum delay of a signal or a service call [s]
_NANOSECONDS: Final = 1_000_000_000


@dataclasses.dataclass(frozen=True)
class PlayerParameters:
    """Parameters that can be set during playback; the rest are options."""

    rate: float = parameter(
        1.0,
        unit="-",
        description="Ratio of playback speed to recording speed.",
        lower=MIN_RATE,
        upper=MAX_RATE,
    )
    seek: float = parameter(
        0.0, unit="s", description="Jump to this time after the bag's first message.", lower=0.0
    )

    def __post_init__(self) -> None:
        """Check the fields."""
        check_fields(self)


class RigAppearedError(Exception):
    """Appearance of a rig while topics are played under their own names."""


class Player(WholeNode):
    """Publishes the messages of a bag when they are due."""

    def __init__(self, options: PlayerOptions, contents: BagDirectory) -> None:
        super().__init__("player")
        self._options = options
        self._contents = contents
        self.start = contents.start + round(options.start * 1e9)
        end = min(options.end, (contents.end - contents.start) / 1e9)
        self.end = contents.start + round(end * 1e9)
        self._topics = self._playable()
        self._senders: dict[str, Publisher] = {}
        self._diagnostics = DiagnosticsPublisher(self)
        now = time.monotonic()
        self.clock = PlaybackClock(options.rate, self.start, now, paused=options.paused)
        self._next_clock = 0.0
        self._checked_at = 0.0
        self.alongside_rig = False
        self.messages = 0
        self.seek_target: int | None = None  # recording time [ns]
        self._begin = self.start
        self.create_service(SetBool, "~/pause", self._on_pause)
        NodeParameters(self, PlayerParameters)
        self.set_parameters([Parameter("rate", value=options.rate)])
        self.add_post_set_parameters_callback(self._on_parameters)

    def _playable(self) -> dict[str, BagTopic]:
        """Return the topics to play; log the reasons why others are left out."""
        options, known = self._options, self._contents.topics
        chosen = {name: topic for name, topic in known.items() if name in options.topics}
        if not chosen:
            raise UserError(f"{options.bag}: no topic is chosen; it has {', '.join(known)}")
        if options.clock is not None:
            chosen.pop(CLOCK, None)
        playable = {}
        for name, topic in chosen.items():
            why = unplayable(topic)
            if why:
                self.get_logger().warning(f"{name} is not played: {why}")
            else:
                playable[name] = topic
        if chosen and not playable:
            raise UserError(f"{options.bag}: none of its topics can be played")
        return playable

    def prepare(self, spin: partial[None], end: ShutdownFlag) -> bool:
        """Check for a rig, create the publishers, and wait for existing subscribers.

        Returns
        -------
        bool
            False if `end` was requested in the meantime.

        Raises
        ------
        UserError
            If a ROS remapping would pass a guarded topic to a rig.
        """
        self._make_publishers()
        begin = time.monotonic()
        while time.monotonic() < begin + DISCOVERY and not (self.alongside_rig or end.requested):
            spin()
            if self._rig() is not None:
                self.get_logger().warning(f"a rig runs on this graph: playing under {REPLAY}")
                self.alongside_rig = True
                self._make_publishers()
                begin = time.monotonic()
        while time.monotonic() < begin + DISCOVERY + MATCHING and not end.requested:
            if self._all_matched():
                break
            spin()
        if end.requested:
            return False
        self._publish_latched(self.start)
        self.clock.restart(self.start, time.monotonic())
        return True

    def _make_publishers(self) -> None:
        for sender in self._senders.values():
            self.destroy_publisher(sender)
        self._senders = {name: self._make_publisher(topic) for name, topic in self._topics.items()}
        if self._options.clock is not None:
            name = played_name(CLOCK, "rosgraph_msgs/msg/Clock", alongside_rig=self.alongside_rig)
            self._senders[CLOCK] = self.create_publisher(Clock, name, RELIABLE)

    def _make_publisher(self, topic: BagTopic) -> Publisher:
        name = played_name(topic.name, topic.type_name, alongside_rig=self.alongside_rig)
        publisher = self.create_publisher(
            message_class(topic.type_name),
            name,
            recorded_offer(topic.type_name, topic.offered_qos),
        )
        # ROS remappings apply to this name, so check the final one.
        final = publisher.topic_name
        if not final.startswith(f"{REPLAY}/") and (
            self.alongside_rig
            or is_guarded(final, topic.type_name)
            or is_guarded(topic.name, topic.type_name)
        ):
            raise UserError(f"{topic.name} must not be played as {final}: a rig would execute it")
        return publisher

    def _all_matched(self) -> bool:
        return all(
            publisher.get_subscription_count() >= self.count_subscribers(publisher.topic_name)
            for publisher in self._senders.values()
        )

    def _publish_latched(self, before: int) -> None:
        """Publish the last latched message of each topic before a recording time [ns]."""
        latched = {name for name, topic in self._topics.items() if topic.is_latched}
        if before == self._contents.start or not latched:
            return
        last = {m.topic: m for m in self._messages(latched, self._contents.start, before)}
        for message in sorted(last.values(), key=lambda one: one.log_time):
            self.publish(message)

    def _messages(self, topics: Container[str], start: int, stop: int) -> Iterator[SentMessage]:
        with BagDirectory(self._options.bag) as bag:
            yield from bag.messages(topics.__contains__, start, stop)

    def read(self) -> Iterator[SentMessage]:
        """Yield the messages to play, in order, from the current start."""
        return self._messages(self._topics, self._begin, self.end + 1)

    def begin(self) -> None:
        """Start at the seek target, or at the beginning."""
        self._begin = self.start if self.seek_target is None else self.seek_target
        if self.seek_target is not None:
            self._publish_latched(self._begin)
        self.seek_target = None
        self.clock.restart(self._begin, time.monotonic())

    def publish(self, message: SentMessage) -> None:
        """Publish a message."""
        self._senders[message.topic].publish(message.data)
        self.messages += 1

    def check_graph(self) -> None:
        """Publish the clock and the state, and check for a rig.

        Raises
        ------
        RigAppearedError
            If a rig appeared while topics are played under their own names.
        """
        now = time.monotonic()
        if self._options.clock is not None and now >= self._next_clock:
            self._next_clock = now + 1.0 / self._options.clock
            self._senders[CLOCK].publish(Clock(clock=rclpy_types().time(self.clock.time(now))))
        if now - self._checked_at < CHECK_PERIOD:
            return
        self._checked_at = now
        rig = None if self.alongside_rig else self._rig()
        if rig is not None:
            raise RigAppearedError(rig)
        state = "paused" if self.clock.is_paused else "playing"
        values = {"bag": str(self._options.bag), "messages": str(self.messages)}
        self._diagnostics.set("playback", Diagnostic(Level.OK, state, values))

    def finish(self) -> None:
        """Wait until all subscribers have received all messages."""
        timeout = Duration(seconds=ACKNOWLEDGED)
        for publisher in self._senders.values():
            publisher.wait_for_all_acked(timeout)

    def _rig(self) -> str | None:
        """Return a description of a publisher that belongs to a rig, or None."""
        for name, _ in self.get_topic_names_and_types():
            if marks_a_rig(name):
                for info in self.get_publishers_info_by_topic(name):
                    if info.node_name != self.get_name():
                        return f"{info.node_name} publishes {name}"
        return None

    def _on_parameters(self, changes: list[Parameter[Any]]) -> None:
        for change in changes:
            if change.name == "rate":
                self.clock.set_rate(change.value, time.monotonic())
            elif change.name == "seek":
                time_ns = self._contents.start + round(change.value * _NANOSECONDS)
                self.seek_target = min(time_ns, self.end)

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> Any:
        self.clock.pause(request.data, time.monotonic())
        response.success = True
        response.message = "paused" if request.data else "playing"
        return response


def _play(player: Player, loop: bool, end: ShutdownFlag) -> int:
    executor = SingleThreadedExecutor()
    executor.add_node(player)
    bar = tqdm(
        total=round((player.end - player.start) / _NANOSECONDS, 1),
        unit="s",
        disable=None,
        leave=False,
        bar_format="{desc} {bar} {n:.1f}/{total:.1f} s",
    )
    with bar:
        if not player.prepare(partial(executor.spin_once, 0.05), end):
            return EXIT_DONE
        while True:
            messages = player.read()
            message = next(messages, None)
            while message is not None and player.seek_target is None:
                # An executor turn is more expensive than a message: publish several per turn.
                wait = player.clock.wait(message.log_time, time.monotonic())
                turn = time.monotonic() + MAX_TURN
                while wait == 0.0 and message is not None and time.monotonic() < turn:
                    player.publish(message)
                    message = next(messages, None)
                    if message is not None:
                        wait = player.clock.wait(message.log_time, time.monotonic())
                executor.spin_once(min(wait, MAX_TURN))
                player.check_graph()
                if end.requested:
                    return EXIT_DONE
                elapsed = player.clock.time(time.monotonic()) - player.start
                bar.n = min(bar.total, elapsed / _NANOSECONDS)
                bar.set_description("paused" if player.clock.is_paused else "playing")
            if not loop and player.seek_target is None:
                player.finish()
                return EXIT_DONE
            player.begin()


def main(args: list[str] | None = None) -> int:
    """Run the player; return the exit code."""
    argv = list(sys.argv if args is None else args)
    ros_from = argv.index("--ros-args") if "--ros-args" in argv else len(argv)

    def command() -> int:
        options = parse_options(argv[1:ros_from])
        contents = read_contents(options.bag)
        require_fits(options, contents)

        def spin(node: Node, end: ShutdownFlag) -> int:
            player = cast(Player, node)
            try:
                code = _play(player, options.loop, end)
            except RigAppearedError as error:
                print(
                    f"error: a rig started on this graph ({error}): playing ended; give one of "
                    "the two its own ROS_DOMAIN_ID",
                    file=sys.stderr,
                )
                return EXIT_MISSED
            print(f"played {player.messages} messages of {options.bag}")
            return code

        return run_node(
            lambda: Player(options, contents),
            help_text="",
            parameters=PlayerParameters,
            args=[argv[0], *argv[ros_from:]],
            spin=spin,
        )

    return run_command(command)


if __name__ == "__main__":
    sys.exit(main())
