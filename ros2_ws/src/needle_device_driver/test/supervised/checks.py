"""What tests of several rules check in the same way."""

from __future__ import annotations

from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.states import State

from .drive_bench import DriveBench
from .ideal_axes import Bench


def in_state(bench: Bench | DriveBench, state: State) -> bool:
    """Return whether the device is in a state, in a way that no type checker remembers."""
    return bool(bench.state is state)


def refused(bench: Bench, rule: Rule) -> str:
    """Check that the last command was refused whole by a rule; return the reason."""
    bench.cycle(3, holding=True)
    assert bench.last_rule is rule
    assert bench.results[-1].outcome.startswith("aborted: ")
    assert not in_state(bench, State.MOVING)
    assert bench.positions == (0.0, 0.0)
    return str(bench.results[-1].outcome)


def failed(bench: DriveBench, rule: Rule, text: str) -> None:
    """Check that the device is in FAULT by a rule, and that nothing moves any more."""
    assert in_state(bench, State.FAULT)
    assert bench.notices[-1].rule is rule
    assert text in bench.status.fault
    assert bench.outcomes[-1].startswith("aborted: ")
    at = bench.positions
    bench.cycle(10, holding=True)
    assert bench.positions == at
    assert in_state(bench, State.FAULT)


def recovers(bench: DriveBench) -> None:
    """Check that reset moves nothing and that a new command moves again, and only that."""
    at = bench.positions
    bench.hold(False)
    reply = bench.run(bench.supervisor.reset(bench.clock()))
    assert reply.success, reply.message
    bench.cycle(10)
    assert in_state(bench, State.DISABLED)
    assert bench.supervisor.enable(True, bench.clock()).success
    bench.cycle(12)
    bench.hold(False)
    bench.cycle(3, holding=True)
    assert bench.positions == at
    bench.step()
    bench.cycle(30, holding=True)
    assert bench.outcomes[-1] == "succeeded"


def steps(bench: DriveBench) -> None:
    """Home, enable and take a step; it ends where it should."""
    bench.ready()
    at = bench.positions
    bench.cycle(1, holding=True)
    bench.step(0.001, 0.3)
    bench.cycle(40, holding=True)
    assert bench.outcomes == ["succeeded"]
    assert bench.positions[0] == at[0] + 20_000
