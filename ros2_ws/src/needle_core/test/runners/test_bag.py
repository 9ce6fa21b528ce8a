"""A component run from a bag: timers follow recorded time, unused messages are dropped."""

from __future__ import annotations

import math

from needle_core import component as c
from needle_core import messages as m
from needle_core.runners.bag import BagRunner


class Clerk(c.Component):
    """Records its ticks and peers; repeats received messages on a topic and at a port."""

    name = "clerk"

    def __init__(self) -> None:
        self.ticks: list[float] = []
        self.peers = c.Peers()
        self.batches: list[object] = []
        self.inputs = (c.Input("in", m.Text, self._on_text),)
        self.outputs = (c.Output("out", m.Text), c.Output("aside", m.Text))
        self.timers = (c.Timer(0.5, self._on_time),)
        self.ports = (c.Port("door", self._on_batch),)

    def on_peers(self, peers: c.Peers, at: c.Moment) -> c.Actions:
        self.peers = peers
        return ()

    def _on_text(self, message: m.Text, at: c.Moment) -> c.Actions:
        yield c.Log("info", "received")
        yield c.Publish("out", message)
        yield c.Publish("aside", message)
        yield c.Send("door", (message.text,))

    def _on_time(self, at: c.Moment) -> c.Actions:
        self.ticks.append(at.steady)
        yield c.Publish("out", m.Text(f"tick {len(self.ticks)}"))

    def _on_batch(self, batch: object, at: c.Moment) -> c.Actions:
        self.batches.append(batch)
        yield c.Publish("out", m.Text("knock"))


def replay(clerk: Clerk, *times: float) -> tuple[BagRunner, list[str]]:
    runner = BagRunner(clerk, ["out"])
    texts = [
        action.message.text
        for time in times
        for action in runner.deliver("in", m.Text(f"at {time}"), c.Moment(time, 0))
    ]
    return runner, texts


def test_timers_tick_before_the_message_at_which_they_are_due() -> None:
    clerk = Clerk()
    _, texts = replay(clerk, 10.0, 10.4, 10.6, 10.9, 11.0)
    assert clerk.ticks == [10.6, 11.0]
    assert texts == ["at 10.0", "at 10.4", "tick 1", "at 10.6", "at 10.9", "tick 2", "at 11.0"]


def test_messages_without_subscriber_are_dropped_and_the_others_counted() -> None:
    clerk = Clerk()
    runner, texts = replay(clerk, 1.0, 1.1)
    assert texts == ["at 1.0", "at 1.1"]
    assert runner.counts == {"out": 2, "door": 2}
    assert set(clerk.peers.subscribers) == {"out"}


def test_port_input_is_handled_and_every_timer_has_a_last_tick() -> None:
    clerk = Clerk()
    runner, _ = replay(clerk, 1.0)
    (answer,) = runner.arrive("door", ("a", "b"), c.Moment(1.0, 0))
    assert (answer.message.text, clerk.batches) == ("knock", [("a", "b")])
    assert [action.message.text for action in runner.finish(c.Moment(math.inf, 0))] == ["tick 1"]
    assert clerk.ticks == [math.inf]
