"""Mishaps of the virtual runner: what is killed, slow, changed, out of order."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

import pytest

from needle_core.component import (
    LATCHED,
    Actions,
    Call,
    Log,
    Moment,
    Port,
    PortChange,
    Reply,
)
from needle_core.runners.faults import (
    Arrival,
    Arrivals,
    Fault,
    Link,
    drop,
    duplicate,
)
from needle_core.runners.timeline import START_NS
from needle_core.runners.virtual import LEASE, VirtualRunner

from .runner_scene import Once, Receiver, Sender, Server, Wired, run


def senders(receiver: Receiver) -> list[str]:
    return list(receiver.peers[-1].publishers.get("numbers", ()))


def test_messages_keep_their_order_but_for_what_overtakes() -> None:
    def late(link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        return (Arrival(0.35 if int(message.position[0]) % 5 == 0 else 0.0, message, overtakes),)

    for overtakes in (False, True):
        receiver = Receiver()
        run([Sender(), receiver], faults=[late])
        assert (receiver.numbers == sorted(receiver.numbers)) is not overtakes
        assert {5, 6, 7, 8, 9, 10} <= set(receiver.numbers)


def test_a_killed_component_is_gone_with_what_it_had_and_missed_after_a_while() -> None:
    sender, receiver = Sender(delivery=LATCHED), Receiver()
    runner = VirtualRunner([sender, receiver], seed=1)
    runner.run(1.0)
    assert runner.is_up("sender")
    count, known = sender.count, len(receiver.peers)
    runner.kill("sender")
    late = Receiver("late")
    runner.start(late)
    runner.run(LEASE - 0.1)
    assert not runner.runs("sender")
    assert (sender.count, late.numbers) == (count, [])
    # It has found the one that came late.
    assert len(receiver.peers) == known + 1
    assert senders(receiver) == ["sender"]
    runner.run(0.2)
    assert senders(receiver) == []


def test_a_component_is_made_anew_and_found_again() -> None:
    receiver, server = Receiver(), Server(lambda *_: ())
    runner = VirtualRunner([Sender(), receiver, server], seed=1)
    with pytest.raises(ValueError, match="component 'sender' runs already"):
        runner.start(Sender())
    runner.run(1.0)
    runner.kill("sender")
    runner.start(Sender())
    runner.run(1.0)
    assert receiver.numbers[-1] < 11
    assert senders(receiver) == ["sender", "sender"]
    runner.run(LEASE)
    assert senders(receiver) == ["sender"]
    runner.stop("sender")
    assert runner.run(1.0)
    runner.start(Sender())
    assert runner.exits == {}


def test_a_component_that_is_slowed_down_falls_behind_for_a_while() -> None:
    receiver = Receiver()
    runner = VirtualRunner([Sender(), receiver], seed=1)
    runner.run(1.0)
    runner.slow_down("receiver", 1.0, 0.25)
    runner.run(1.0)
    assert len(receiver.numbers) < 15
    runner.run(1.0)
    assert receiver.numbers[-10:] == list(range(receiver.numbers[-1] - 9, receiver.numbers[-1] + 1))


def test_settings_change_by_an_event() -> None:
    class Settled(Sender):
        def on_settings(self, settings: Any, at: Moment) -> Actions:
            yield Log("info", f"{settings} at {at.steady:.1f}")

    lines: list[Any] = []
    runner = VirtualRunner([Settled()], taps=(lambda *told: lines.append(told[2]),))
    runner.run(1.0)
    runner.configure("sender", 7)
    runner.run(0.01)
    assert lines[-1].text == "7 at 1.0"


def test_the_clock_of_stamps_may_jump() -> None:
    receiver = Receiver()
    runner = VirtualRunner([Sender(), receiver], seed=1)
    runner.run(1.0)
    runner.timeline.clock_offset_ns = -500_000_000
    runner.run(1.0)
    assert runner.timeline.stamp_ns == START_NS + 1_500_000_000
    assert receiver.received[-1][1].steady > 1.9


def test_faults_apply_to_calls_and_their_answers() -> None:
    def numbers(*faults: Fault) -> list[int]:
        asked: list[int] = []

        def serve(on: bool | None, number: int, at: Moment) -> Actions:
            asked.append(number)
            yield Reply(number, True)

        run([once, Server(serve)], faults=faults)
        return asked

    once = Once([Call("serve", True)])
    first, second = numbers(duplicate("serve", 0.1))
    assert first == second
    assert len(once.answers) == 1
    once = Once([Call("serve", True)])
    assert numbers(drop("serve", 1.0)) == []
    assert once.answers == []


def test_a_port_is_lost_and_opened_also_for_who_starts_meanwhile() -> None:
    def wired(name: str, *, sends: bool = False) -> Wired:
        component = Wired(name, sends=sends)
        component.ports = (Port("wire", component._take, note),)
        return component

    def note(change: PortChange, at: Moment) -> Actions:
        changes.append(change.lost)
        return ()

    changes: list[str] = []
    one, other = wired("one", sends=True), wired("other")
    runner = VirtualRunner([one, other])
    runner.run(0.1)
    runner.lose_port("other", "wire", "unplugged")
    runner.run(0.1)
    assert 0 < len(other.arrived) < one.count - 100
    runner.kill("other")
    anew = wired("other")
    runner.start(anew)
    runner.run(0.1)
    assert anew.arrived == []
    runner.open_port("other", "wire")
    runner.run(0.1)
    assert anew.arrived
    assert changes == ["unplugged", "unplugged", ""]


def test_what_waits_at_a_port_is_one_batch() -> None:
    batches: list[int] = []
    one, other = Wired("one", sends=True), Wired("other")

    def take(batch: Sequence[int], at: Moment) -> Actions:
        batches.append(len(batch))
        return other._take(batch, at)

    other.ports = (Port("wire", take),)
    runner = VirtualRunner([one, other])
    runner.run(0.1)
    assert max(batches) <= 6
    runner.freeze("other", 0.1)
    runner.run(0.2)
    assert max(batches) > 100
    numbers = [number for _, number in other.arrived]
    assert numbers == list(range(1, len(numbers) + 1))
