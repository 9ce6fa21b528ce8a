"""The virtual runner: repeatable, and as unkind as a graph."""

from __future__ import annotations

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
    Port,
    Publish,
    Reply,
)
from needle_core.diagnostics import Diagnostic, Level
from needle_core.messages import EmergencyStop
from needle_core.runners.faults import (
    Fault,
    delay,
    drop,
    duplicate,
    silence,
)
from needle_core.runners.timeline import START_NS
from needle_core.runners.virtual import DISCOVERY, VirtualRunner

from .runner_scene import Once, Receiver, Sender, Server, Wired, run


def test_the_same_seed_is_the_same_run_and_another_seed_another() -> None:
    one, again, other = (run([Sender(), Receiver()], seed=seed)[1] for seed in (1, 1, 2))
    assert one == again
    assert one != other
    assert len(one) == pytest.approx(30, abs=1)


def test_another_component_changes_no_draw_of_the_others() -> None:
    alone, beside = Receiver(), Receiver()
    run([Sender(), alone])
    run([Once([]), Sender(), beside, Server(lambda *_: ())])
    # While the others are found, their news keep the receiver busy.
    settled = DISCOVERY[1] + 0.1
    late = [[item for item in r.received if item[1].steady > settled] for r in (alone, beside)]
    assert late[0] == late[1] != []


def test_a_message_takes_its_time_and_says_when_it_was_sent() -> None:
    receiver = Receiver()
    run([Sender(), receiver])
    for _, at in receiver.received:
        late = at.stamp_ns - at.sent_ns
        assert 300_000 <= late <= 1_500_000
        assert at.stamp_ns == START_NS + round(at.steady * 1e9)


def test_what_is_sent_before_discovery_is_lost_but_for_what_is_latched() -> None:
    plain, latched = Receiver(), Receiver()
    run([Sender(), plain], seed=3)
    run([Sender(delivery=LATCHED), latched], seed=3)
    assert DISCOVERY[0] <= latched.received[0][1].steady <= DISCOVERY[1] + 0.1
    assert plain.numbers == list(range(plain.numbers[0], plain.numbers[0] + len(plain.numbers)))
    assert set(plain.numbers) <= set(latched.numbers)


def test_peers_are_told_as_they_are_found() -> None:
    receiver = Receiver()
    run([Sender(), Sender("second"), receiver, Server(lambda *_: ())])
    last = receiver.peers[-1]
    assert set(last.publishers["numbers"]) == {"sender", "second"}
    assert last.subscribers["numbers"] == ("receiver",)
    assert last.services == {"serve"}
    assert len(receiver.peers) == 3


@pytest.mark.parametrize(
    ("delivery", "expected"),
    [(Delivery(depth=2, reliable=False), 2), (RELIABLE, 10)],
)
def test_a_frozen_receiver_keeps_what_its_queue_holds(delivery: Delivery, expected: int) -> None:
    receiver = Receiver(delivery=delivery)
    runner = VirtualRunner([Sender(), receiver], seed=1)
    runner.run(1.0)
    before = len(receiver.received)
    runner.freeze("receiver", 1.0)
    runner.run(0.999)
    assert len(receiver.received) == before
    runner.run(0.05)
    assert len(receiver.received) - before in (expected, expected + 1)


def test_a_timer_that_was_missed_fires_once() -> None:
    sender = Sender()
    runner = VirtualRunner([sender], seed=1)
    runner.run(1.0)
    before = sender.count
    runner.freeze("sender", 1.0)
    runner.run(1.001)
    assert sender.count - before in (1, 2)


def test_faults_of_deliveries() -> None:
    def numbers(*faults: Fault) -> list[int]:
        receiver = Receiver()
        run([Sender(), receiver], seed=1, faults=faults)
        return receiver.numbers

    whole = numbers()
    assert numbers(drop("others", 1.0)) == whole
    assert numbers(drop("numbers", 1.0)) == []
    assert 0 < len(numbers(drop("numbers", 0.5))) < len(whole)
    twice = numbers(duplicate("numbers", 0.15))
    assert [twice.count(number) for number in range(5, 25)] == [2] * 20
    lost = set(whole) - set(numbers(silence("sender", 1.0, 1.5)))
    assert len(lost) == 5
    assert max(lost) - min(lost) == 4


def test_a_delayed_message_comes_late() -> None:
    receiver = Receiver()
    run([Sender(), receiver], faults=[delay("numbers", 0.4)])
    assert all(at.stamp_ns - at.sent_ns >= 400_000_000 for _, at in receiver.received)


def test_a_call_is_answered_now_or_later() -> None:
    def at_once(on: bool | None, number: int, at: Moment) -> Actions:
        yield Reply(number, bool(on), f"asked {on}")

    once = Once([Call("serve", True)])
    run([once, Server(at_once)])
    assert once.answers == [Answer("serve", True, "asked True")]


def test_a_call_without_server_or_answer_fails() -> None:
    nobody, silent = Once([Call("serve", True)]), Once([Call("serve", True)])
    run([nobody])
    run([silent, Server(lambda *_: ())], seconds=1.0 + ANSWER_TIMEOUT)
    assert nobody.answers == [Answer("serve", False, "no server", answered=False)]
    assert silent.answers == [Answer("serve", False, "no answer", answered=False)]


def test_a_handler_that_raises_is_reported_and_ends_nothing() -> None:
    class Broken(Sender):
        def _send(self, at: Moment) -> Actions:
            yield from super()._send(at)
            if self.count == 5:
                raise ZeroDivisionError("by zero")

    receiver = Receiver()
    _, told = run([Broken(), receiver])
    lines = [message for _, _, topic, message in told if topic == "/rosout"]
    assert [line.text for line in lines] == ["internal error: ZeroDivisionError: by zero"]
    health = [message for _, _, topic, message in told if topic == "/diagnostics"]
    assert health[0].statuses[0].level is Level.ERROR
    assert {4, 5, 6} <= set(receiver.numbers)


def test_what_is_no_output_is_not_sent() -> None:
    _, told = run([Once([Publish("others", EmergencyStop(True))])])
    (line,) = [message for *_, topic, message in told if topic == "/rosout"]
    assert line.text == "internal error: ValueError: others is not among its outputs"


def test_health_is_told_on_change_and_once_a_second() -> None:
    well = Diagnose("part", Diagnostic(Level.OK, "well", {"count": "1"}))
    counted = Diagnose("part", Diagnostic(Level.OK, "well", {"count": "2"}))
    ill = Diagnose("part", Diagnostic(Level.WARN, "ill"))
    _, told = run([Once([well, counted, ill])])
    health = [m.statuses[0].text for _, _, topic, m in told if topic == "/diagnostics"]
    assert health == ["well", *["ill"] * 4]


def test_a_component_that_exits_does_nothing_more_and_ends_the_run() -> None:
    once = Once([Exit(1, "done"), Log("info", "never said")])
    runner, told = run([once, Sender()])
    assert runner.exits == {"once": Exit(1, "done")}
    assert 0.5 <= runner.now < 0.7
    assert not [message for *_, topic, message in told if topic == "/rosout"]


def test_a_component_that_is_asked_to_end_exits() -> None:
    runner = VirtualRunner([Sender()])
    runner.stop("sender")
    assert runner.run(1.0)
    assert runner.exits == {"sender": Exit(0)}
    with pytest.raises(ValueError, match="no component 'nobody'"):
        runner.stop("nobody")


def test_what_goes_through_a_port_arrives_at_the_others_of_its_name_in_order() -> None:
    one, other, third = Wired("one", sends=True), Wired("other"), Wired("third")
    third.ports = (Port("another wire", third._take),)
    VirtualRunner([one, other, third]).run(0.1)
    numbers = [number for _, number in other.arrived]
    # Wires are there at once, while discovery takes a while.
    assert numbers == list(range(1, len(numbers) + 1))
    assert one.count - 12 < len(numbers) <= one.count
    assert other.arrived[0][0] < 0.003
    assert one.arrived == third.arrived == []


def test_faults_apply_to_what_goes_through_a_port() -> None:
    one, other = Wired("one", sends=True), Wired("other")
    VirtualRunner([one, other], faults=(drop("wire", 0.5),)).run(0.1)
    assert 0.3 * one.count < len(other.arrived) < 0.7 * one.count
