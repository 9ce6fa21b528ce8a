"""Random sequences of events never cause a forbidden motion."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

from hypothesis import given, settings
from hypothesis import strategies as st

from .ideal_axes import Bench, IdealAxis

Event: TypeAlias = Callable[[Bench], object]

_LIMITS = {"max_depth": 0.006, "max_turns": 0.3}


def _named(name: str, event: Event) -> Event:
    event.__name__ = name
    return event


def _homeless(bench: Bench) -> None:
    bench.insertion.homed = False
    # The supervisor is updated by the next feedback of the axis.
    bench.supervisor.observe(bench.now)


_EVENTS: dict[str, Event] = {
    "press": lambda bench: bench.hold(),
    "release": lambda bench: bench.hold(False),
    "press b": lambda bench: bench.hold(sender="b"),
    "release b": lambda bench: bench.hold(False, sender="b"),
    "old press": lambda bench: bench.hold(count=-1),
    "silence": lambda bench: setattr(bench, "now", bench.now + 0.3),
    "enable": lambda bench: bench.enable(),
    "disable": lambda bench: bench.enable(False),
    "stop": lambda bench: bench.supervisor.stop(),
    "estop": lambda bench: bench.supervisor.receive_estop(True),
    "estop off": lambda bench: bench.supervisor.receive_estop(False),
    "retract": lambda bench: bench.retract(),
    "reset": lambda bench: bench.reset(),
    "home": lambda bench: bench.home(),
    "fault": lambda bench: setattr(bench.rotation, "fault", "stalled"),
    "forget home": _homeless,
}
_cycles = st.builds(
    lambda count, scale: _named(
        f"{count} cycles at {scale}",
        lambda bench: bench.wait(count) if scale is None else bench.go(count, scale),
    ),
    st.integers(1, 12),
    st.sampled_from([None, None, 0.0, 0.3, 1.0, 1.0, 7.0, math.nan]),
)
_commands = st.builds(
    lambda *step: _named(f"step{step}", lambda bench: bench.step(*step[:3], publishers=step[3])),
    st.sampled_from([0.001, 0.002, 0.0005, -0.001, 0.01, math.inf, math.nan]),
    st.sampled_from([0.0, 0.5, -1.2, 3.0]),
    st.sampled_from([0.5, 1.0, 0.01, -1.0]),
    st.sampled_from([1, 1, 1, 2]),
)
_others = st.sampled_from([_named(name, event) for name, event in _EVENTS.items()])


class Witness(Bench):
    """Checks every cycle with an independent model of the hold."""

    def __init__(self) -> None:
        self.received: dict[str, tuple[float, bool]] = {}
        super().__init__(**_LIMITS)

    def hold(self, pressed: bool = True, *, sender: str = "a", **more: Any) -> str:
        good = 0.0 <= more.get("scale", 1.0) <= 1.0
        if not pressed or not good or more.get("count") is None:
            self.received[sender] = (self.now, pressed and good)
        return super().hold(pressed, sender=sender, **more)

    def exchange(self) -> None:
        self.supervisor.drive(0.02, self.now)
        limits = self.limits
        inward = self._moved(self.insertion, limits.max_speed)
        assert inward <= 0.0 or self.insertion.homed, "moved inward while not homed"
        assert self.insertion.position <= limits.max_depth + 1e-12
        turned = self._moved(self.rotation, limits.max_rotation_rate)
        assert turned == 0.0 or self.activity in ("step", "homing")
        assert abs(self.rotation.position) <= limits.max_rotation + 1e-12
        self.supervisor.observe(self.now)

    def _moved(self, axis: IdealAxis, fastest: float) -> float:
        before = axis.position
        axis.advance(0.02)
        moved = axis.position - before
        assert abs(moved) <= fastest * 0.02 * (1 + 1e-6)
        if moved != 0.0:
            assert self.state == "MOVING"
            held = [pressed and self.now - at <= 0.25 for at, pressed in self.received.values()]
            assert self.activity == "homing" or any(held), "moved without a hold"
        return moved


@settings(max_examples=80, deadline=None, derandomize=True)
@given(
    is_ready=st.booleans(),
    events=st.lists(st.one_of(_cycles, _cycles, _commands, _others), max_size=40),
)
def test_no_motion_without_hold_or_beyond_limits(is_ready: bool, events: list[Event]) -> None:
    bench = Witness()
    if is_ready:
        bench.ready()
        bench.step()
    else:
        bench.configure()
    for event in events:
        event(bench)
        assert (bench.state == "MOVING") is (bench.activity != "none")
    assert all(o == "succeeded" or o.startswith("aborted: ") for o in bench.outcomes)
