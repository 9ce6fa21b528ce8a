"""Components for tests of the virtual runner."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from needle_core.component import (
    LATCHED,
    RELIABLE,
    Action,
    Actions,
    Answer,
    Component,
    Delivery,
    Input,
    Moment,
    Output,
    Peers,
    Publish,
    Reply,
    Service,
    Timer,
)
from needle_core.messages import EmergencyStop, Point
from needle_core.runners.virtual import VirtualRunner


class Sender(Component):
    """Publishes increasing numbers on `numbers` every 0.1 s."""

    def __init__(self, name: str = "sender", delivery: Delivery = RELIABLE) -> None:
        self.name = name
        self.count = 0
        self.outputs = (Output("numbers", Point, delivery),)
        self.timers = (Timer(0.1, self._send),)

    def _send(self, at: Moment) -> Actions:
        self.count += 1
        yield Publish("numbers", Point(at.stamp_ns, "rig", (float(self.count), 0.0, 0.0)))


class Receiver(Component):
    """Stores received messages with their time."""

    def __init__(self, name: str = "receiver", delivery: Delivery = RELIABLE) -> None:
        self.name = name
        self.received: list[tuple[float, Moment]] = []
        self.peers: list[Peers] = []
        self.inputs = (Input("numbers", Point, self._receive, delivery),)

    @property
    def numbers(self) -> list[int]:
        return [int(number) for number, _ in self.received]

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        self.peers.append(peers)
        return ()

    def _receive(self, message: Point, at: Moment) -> Actions:
        self.received.append((message.position[0], at))
        return ()


class Once(Component):
    """Acts once at 0.5 s, and keeps the answers to its calls."""

    def __init__(self, actions: Sequence[Action], name: str = "once") -> None:
        self.name = name
        self.answers: list[Answer] = []
        self.outputs = (Output("numbers", Point, LATCHED), Output("stop", EmergencyStop))
        self.timers = (Timer(0.1, self._tick),)
        self._actions = list(actions)

    def _tick(self, at: Moment) -> Actions:
        if at.steady >= 0.5:
            while self._actions:
                yield self._actions.pop(0)

    def on_answer(self, answer: Answer, at: Moment) -> Actions:
        self.answers.append(answer)
        return ()


class Server(Component):
    """Sends the given answers; none by default."""

    name = "server"

    def __init__(self, *replies: Reply) -> None:
        self.asked: list[tuple[int, bool | None]] = []
        self._replies = replies
        self.services = (Service("serve", self._answer, has_argument=True),)

    def _answer(self, on: bool | None, number: int, at: Moment) -> Actions:
        self.asked.append((number, on))
        return [dataclasses.replace(reply, request=number) for reply in self._replies]


def run(
    components: Sequence[Component], seconds: float = 3.0, **options: Any
) -> tuple[VirtualRunner, list[tuple[int, str, Any]]]:
    """Run; return all publications: stamp, topic, message."""
    published: list[tuple[int, str, Any]] = []

    def tap(stamp: int, sender: str, message: Any, output: Output) -> None:
        published.append((stamp, output.topic, message))

    runner = VirtualRunner(components, taps=(tap,), **options)
    runner.run(seconds)
    return runner, published
