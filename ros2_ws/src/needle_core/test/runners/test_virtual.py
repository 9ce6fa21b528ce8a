"""The virtual runner: repeatable, with the faults of a real graph."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

import pytest

from needle_core.component import (
    ANSWER_TIMEOUT,
    LATCHED,
    RELIABLE,
    Actions,
    Answer,
    Call,
    Delivery,
    Diagnose,
    Exit,
    Log,
    Moment,
    Publish,
    Reply,
)
from needle_core.diagnostics import Diagnostic, Level
from needle_core.messages import EmergencyStop
from needle_core.runners.timeline import START_NS
from needle_core.runners.transport import Arrival, Arrivals, Link
from needle_core.runners.virtual import DISCOVERY, LEASE, VirtualRunner
from scenario.transport_faults import delay

from .runner_scene import Once, Receiver, Sender, Server, run

NUMBER = 0
"""Number of a request, by which the server of the scene identifies it."""


def texts(published: Sequence[tuple[int, str, Any]]) -> list[str]:
    return [message.text for _, topic, message in published if topic == "/rosout"]


# ---- messages -----------------------------------------------------------------------------------


def test_a_seed_determines_the_run() -> None:
    one, again, other = (run([Sender(), Receiver()], seed=seed)[1] for seed in (1, 1, 2))
    assert one == again
    assert one != other
    assert len(one) == pytest.approx(30, abs=1)


def test_a_message_is_delayed_and_has_its_time_of_sending() -> None:
    receiver, late = Receiver(), Receiver()
    run([Sender(), receiver])
    for _, at in receiver.received:
        assert 300_000 <= at.stamp_ns - at.sent_ns <= 1_500_000
        assert at.stamp_ns == START_NS + round(at.steady * 1e9)
    run([Sender(), late], faults=[delay("numbers", 0.4)])
    assert all(at.stamp_ns - at.sent_ns >= 400_000_000 for _, at in late.received)


def test_messages_before_discovery_are_lost_unless_latched() -> None:
    plain, latched = Receiver(), Receiver()
    run([Sender(), plain], seed=3)
    run([Sender(delivery=LATCHED), latched], seed=3)
    assert DISCOVERY[0] <= latched.received[0][1].steady <= DISCOVERY[1] + 0.1
    assert plain.numbers == list(range(plain.numbers[0], plain.numbers[0] + len(plain.numbers)))
    assert set(plain.numbers) <= set(latched.numbers)


def test_peers_are_reported_as_they_are_discovered() -> None:
    receiver = Receiver()
    run([Sender(), Sender("second"), receiver, Server()])
    last = receiver.peers[-1]
    assert set(last.publishers["numbers"]) == {"sender", "second"}
    assert last.subscribers["numbers"] == ("receiver",)
    assert last.services == {"serve"}
    assert last.nodes == {"sender", "second", "receiver", "server"}
    assert len(receiver.peers) == 3


def test_messages_keep_their_order_unless_a_fault_lets_one_overtake() -> None:
    def late(link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        return (Arrival(0.35 if int(message.position[0]) % 5 == 0 else 0.0, message, overtakes),)

    for overtakes in (False, True):
        receiver = Receiver()
        run([Sender(), receiver], faults=[late])
        assert (receiver.numbers == sorted(receiver.numbers)) is not overtakes
        assert {5, 6, 7, 8, 9, 10} <= set(receiver.numbers)


# ---- services and actions -----------------------------------------------------------------------


def test_a_call_is_answered_once_or_fails_after_its_timeout() -> None:
    server = Server(Reply(NUMBER, True, "as asked"), Reply(NUMBER, False, "twice"))
    for servers, answer in (
        ([server], Answer("serve", True, "as asked")),
        ([], Answer("serve", False, "no server", answered=False)),
        ([Server()], Answer("serve", False, "no answer", answered=False)),
    ):
        once = Once([Call("serve", True)])
        run([once, *servers], seconds=1.0 + ANSWER_TIMEOUT)
        assert once.answers == [answer]
    assert [on for _, on in server.asked] == [True]


def test_a_handler_that_raises_is_reported_and_ends_nothing() -> None:
    class Broken(Sender):
        def _send(self, at: Moment) -> Actions:
            yield from super()._send(at)
            if self.count == 5:
                raise ZeroDivisionError("by zero")

    receiver = Receiver()
    _, published = run([Broken(), receiver])
    assert texts(published) == ["internal error: ZeroDivisionError: by zero"]
    health = [message for _, topic, message in published if topic == "/diagnostics"]
    assert health[0].statuses[0].level is Level.ERROR
    assert {4, 5, 6} <= set(receiver.numbers)
    _, published = run([Once([Publish("others", EmergencyStop(True))])])
    assert texts(published) == ["internal error: ValueError: others is not among its outputs"]


def test_diagnostics_are_published_on_change_and_once_a_second() -> None:
    well = Diagnose("part", Diagnostic(Level.OK, "well", {"count": "1"}))
    counted = Diagnose("part", Diagnostic(Level.OK, "well", {"count": "2"}))
    ill = Diagnose("part", Diagnostic(Level.WARN, "ill"))
    _, published = run([Once([well, counted, ill])])
    health = [m.statuses[0].text for _, topic, m in published if topic == "/diagnostics"]
    assert health == ["well", *["ill"] * 4]


def test_a_component_that_exits_does_nothing_more_and_ends_the_run() -> None:
    once = Once([Exit(1, "done"), Log("info", "never said")])
    runner, published = run([once, Sender()])
    assert runner.exits == {"once": Exit(1, "done")}
    assert 0.5 <= runner.now < 0.7
    assert texts(published) == []
    runner.stop("sender")
    assert runner.run(1.0)
    assert runner.exits["sender"] == Exit(0)
    with pytest.raises(ValueError, match="no component 'nobody'"):
        runner.stop("nobody")


# ---- life of components and faults --------------------------------------------------------------


@pytest.mark.parametrize(
    ("delivery", "expected"), [(Delivery(depth=2, reliable=False), 2), (RELIABLE, 10)]
)
def test_a_frozen_component_keeps_its_queue_and_a_timer_fires_once(
    delivery: Delivery, expected: int
) -> None:
    sender, receiver = Sender(), Receiver(delivery=delivery)
    runner = VirtualRunner([sender, receiver], seed=1)
    runner.run(1.0)
    before = len(receiver.received)
    runner.freeze("receiver", 1.0)
    assert not runner.is_responsive("receiver")
    runner.run(0.999)
    assert len(receiver.received) == before
    runner.run(0.05)
    assert len(receiver.received) - before in (expected, expected + 1)
    count = sender.count
    runner.freeze("sender", 1.0)
    runner.run(1.001)
    assert sender.count - count in (1, 2)


def test_a_killed_component_loses_its_state_and_is_dropped_after_its_lease() -> None:
    sender, receiver, late = Sender(delivery=LATCHED), Receiver(), Receiver("late")
    runner = VirtualRunner([sender, receiver], seed=1)
    with pytest.raises(ValueError, match="component 'sender' is already running"):
        runner.start(Sender())
    runner.run(1.0)
    count = sender.count
    runner.kill("sender")
    runner.start(late)
    runner.run(LEASE - 0.1)
    assert not runner.runs("sender")
    assert (sender.count, late.numbers) == (count, [])
    # It has discovered the late component.
    assert receiver.peers[-1].nodes == {"sender", "receiver", "late"}
    runner.start(Sender())
    runner.run(0.25)
    assert receiver.peers[-1].publishers["numbers"] == ("sender",)
    # The new component counts from 1.
    assert receiver.numbers[-1] < 5
    runner.stop("sender")
    assert runner.run(1.0)
    assert "numbers" not in receiver.peers[-1].publishers
    runner.start(Sender())
    assert runner.exits == {}
