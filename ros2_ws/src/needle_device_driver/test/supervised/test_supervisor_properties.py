"""Whatever happens in whatever order, the needle never moves when or where it must not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

from hypothesis import given, settings
from hypothesis import strategies as st

from needle_device_driver.supervisor.states import Activity, State

from .ideal_axes import Bench

Event: TypeAlias = Callable[[Bench], object]

_LIMITS = {"max_depth": 0.006, "max_turns": 0.3}


def _named(name: str, event: Event) -> Event:
    event.__name__ = name
    return event


def _fault(bench: Bench) -> None:
    bench.rotation.fault = "stalled"


def _forget_home(bench: Bench) -> None:
    bench.insertion.homed = False
    # The supervisor cannot know before the axis' next reply.
    bench.supervisor.observe(bench.now)


def _wait(bench: Bench) -> None:
    bench.now += 0.3


_cycles = st.builds(
    lambda count, holding, scale: _named(
        f"cycle({count}, holding={holding}, scale={scale})",
        lambda bench: bench.cycle(count, holding=holding, scale=scale),
    ),
    st.integers(1, 12),
    st.booleans(),
    st.sampled_from([0.0, 0.3, 1.0, 1.0, 7.0, float("nan")]),
)
_commands = st.builds(
    lambda length, rotation, duration, publishers: _named(
        f"command({length}, {rotation}, {duration}, {publishers})",
        lambda bench: bench.command(length, rotation, duration=duration, publishers=publishers),
    ),
    st.sampled_from([0.001, 0.002, 0.0005, -0.001, 0.01, float("inf"), float("nan")]),
    st.sampled_from([0.0, 0.5, -1.2, 3.0]),
    st.sampled_from([0.5, 1.0, 0.01, -1.0]),
    st.sampled_from([1, 1, 1, 2]),
)
_others = st.sampled_from(
    [
        _named("hold a", lambda bench: bench.hold()),
        _named("release a", lambda bench: bench.hold(False)),
        _named("hold b", lambda bench: bench.hold(sender="b")),
        _named("release b", lambda bench: bench.hold(False, sender="b")),
        _named("old hold a", lambda bench: bench.hold(count=-1)),
        _named("enable", lambda bench: bench.supervisor.enable(True, bench.now)),
        _named("disable", lambda bench: bench.supervisor.enable(False, bench.now)),
        _named("confirm", lambda bench: bench.supervisor.confirm_needle_out(True)),
        _named("home", lambda bench: bench.run(bench.supervisor.home(bench.now))),
        _named("retract", lambda bench: bench.supervisor.retract(bench.now)),
        _named("stop", lambda bench: bench.supervisor.stop()),
        _named("reset", lambda bench: bench.run(bench.supervisor.reset(bench.now))),
        _named("estop", lambda bench: bench.supervisor.receive_estop(True)),
        _named("estop off", lambda bench: bench.supervisor.receive_estop(False)),
        _named("fault", _fault),
        _named("forget home", _forget_home),
        _named("wait", _wait),
    ]
)
_events = st.lists(st.one_of(_cycles, _cycles, _commands, _others), max_size=40)


class Witness:
    """Watches every cycle with a model of the hold of its own, from what was sent alone."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.heard: dict[str, tuple[float, bool]] = {}
        self._hold, self._advance = bench.hold, bench.insertion.advance
        self._advance_rotation = bench.rotation.advance
        bench.hold = self.hold  # type: ignore[method-assign]
        bench.insertion.advance = self.advance  # type: ignore[method-assign]
        bench.rotation.advance = self.advance_rotation  # type: ignore[method-assign]

    def hold(self, pressed: bool = True, *, sender: str = "a", **more: Any) -> None:
        good = 0.0 <= more.get("scale", 1.0) <= 1.0
        if not pressed or not good or more.get("count") is None:
            self.heard[sender] = (self.bench.now, pressed and good)
        self._hold(pressed, sender=sender, **more)

    def _check(self, axis: Any, advance: Callable[[float], None], period: float) -> float:
        before = axis.position
        advance(period)
        moved = float(axis.position - before)
        if moved != 0.0:
            bench = self.bench
            assert bench.state is State.MOVING
            if bench.supervisor.activity is not Activity.HOMING:
                fresh = [
                    pressed and bench.now - at <= bench.limits.hold_timeout
                    for at, pressed in self.heard.values()
                ]
                assert any(fresh), "moved without a hold"
        return moved

    def advance(self, period: float) -> None:
        moved = self._check(self.bench.insertion, self._advance, period)
        axis, limits = self.bench.insertion, self.bench.limits
        assert abs(moved) <= limits.max_speed * period * (1 + 1e-6)
        if moved > 0.0:
            assert axis.homed, "moved inward while not homed"
            assert axis.position <= limits.max_depth + 1e-12

    def advance_rotation(self, period: float) -> None:
        moved = self._check(self.bench.rotation, self._advance_rotation, period)
        axis, limits = self.bench.rotation, self.bench.limits
        activity = self.bench.supervisor.activity
        assert moved == 0.0 or activity in (Activity.STEP, Activity.HOMING)
        assert abs(moved) <= limits.max_rotation_rate * period * (1 + 1e-6)
        assert abs(axis.position) <= limits.max_rotation + 1e-12


def _run(bench: Bench, events: list[Event]) -> None:
    Witness(bench)
    for event in events:
        event(bench)
        if bench.supervisor.activity is Activity.NONE:
            assert bench.state is not State.MOVING
        else:
            assert bench.state is State.MOVING
    outcomes = [result.outcome for result in bench.results]
    assert all(o == "succeeded" or o.startswith("aborted: ") for o in outcomes)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(events=_events)
def test_never_without_hold_never_beyond_limits_from_the_start(
    make_bench: type[Bench], events: list[Event]
) -> None:
    bench = make_bench(**_LIMITS)
    bench.run(bench.supervisor.configure(bench.now))
    _run(bench, events)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(events=_events)
def test_never_without_hold_never_beyond_limits_once_ready(
    make_bench: type[Bench], events: list[Event]
) -> None:
    bench = make_bench(**_LIMITS)
    bench.ready(holding=False)
    _run(bench, [lambda b: b.hold(), lambda b: b.command(), *events])


@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    scales=st.lists(st.floats(0.0, 1.0), max_size=40),
    rotation=st.floats(-1.2, 1.2),
)
def test_rotation_stays_in_proportion_at_any_speed(
    make_bench: type[Bench], scales: list[float], rotation: float
) -> None:
    bench = make_bench()
    bench.ready()
    bench.command(0.001, rotation)
    for scale in scales:
        bench.cycle(1, holding=True, scale=scale)
        insertion, turned = bench.positions
        assert abs(turned - insertion / 0.001 * rotation) < 1e-9
