"""A pair of drives on a scripted bus: what goes over the wire, and what the axes make of it."""

from __future__ import annotations

from typing import Any, TypeAlias

from needle_device_driver.states import State

# conftest's; test modules cannot import it.
Bench: TypeAlias = Any


def in_state(bench: Bench, state: State) -> bool:
    """Return whether the device is in a state, in a way that no type checker remembers."""
    return bool(bench.state is state)


def test_a_step_ends_at_its_target_to_the_count(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.ready()
    bench.cycle(1, holding=True)
    bench.step(0.001, 0.3)
    bench.cycle(30, holding=True)
    assert bench.outcomes == ["succeeded"]
    assert bench.positions == (20_000, round(0.3 * 65536 / 6.283185307179586))
    assert in_state(bench, State.HOLDING)


def test_a_step_right_after_a_release_and_press_waits_for_the_axes(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.moving()
    # All between two cycles.
    bench.hold(False)
    bench.hold()
    bench.step()
    at = bench.positions
    bench.cycle(2, holding=True)
    assert in_state(bench, State.MOVING)
    assert bench.positions == at
    bench.cycle(40, holding=True)
    assert bench.outcomes == ["aborted: hold released", "succeeded"]


def test_enable_and_home_wait_until_the_axes_are_off(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.ready()
    bench.cycle(1, holding=True)
    bench.supervisor.enable(False, bench.clock())
    bench.supervisor.confirm_needle_out(True)
    for reply in (
        bench.supervisor.enable(True, bench.clock()),
        bench.supervisor.home(bench.clock()),
    ):
        assert not reply.success
        assert reply.message.startswith("waiting for")
    bench.cycle(10)
    assert not bench.status.needs_time
    assert bench.supervisor.enable(True, bench.clock()).success
