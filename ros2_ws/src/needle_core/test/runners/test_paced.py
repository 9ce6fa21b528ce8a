"""The paced runner on a simulated wall clock: pace, lag, external input."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, cast

import pytest

from needle_core.component import Actions, Batch, Component, Moment, Port, PortChange, Send, Timer
from needle_core.runners.paced import SLACK, PacedRunner
from wall_clock import WallClock

PERIOD = 0.02


class Worker(Component):
    """Consumes wall-clock time now and then, and records the input of its port."""

    name = "worker"

    def __init__(self, wall: WallClock) -> None:
        self.wall = wall
        self.takes: list[float] = []
        self.ticks: list[tuple[float, float]] = []
        self.received: list[tuple[Any, float]] = []
        self.changes: list[PortChange] = []
        self.ports = (Port("outside", self._receive, self._on_change),)
        self.timers = (Timer(PERIOD, self._tick),)

    def _receive(self, batch: Sequence[Any], at: Moment) -> Actions:
        self.received += [(item, at.steady) for item in batch]
        yield Send("outside", tuple(f"{item} heard" for item in batch))

    def _on_change(self, change: PortChange, at: Moment) -> Actions:
        self.changes.append(change)
        return ()

    def _tick(self, at: Moment) -> Actions:
        self.ticks.append((at.steady, self.wall.now))
        if self.takes:
            self.wall.spend(self.takes.pop(0))
        return ()


class Line:
    """Port to the outside, without a device."""

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.is_open = False

    def open(self, arrive: Callable[[Batch | PortChange], None]) -> None:
        self.arrive, self.is_open = arrive, True

    def send(self, batch: tuple[Any, ...]) -> None:
        self.sent += batch

    def close(self) -> None:
        self.is_open = False


class Scene:
    def __init__(self, pace: float = 1.0) -> None:
        self.wall = WallClock()
        self.worker, self.line = Worker(self.wall), Line()
        self.runner = PacedRunner(
            [self.worker],
            pace=pace,
            ports={"outside": self.line},
            bell=cast(Any, self.wall),
            clock=self.wall,
        )


@pytest.mark.parametrize("pace", [0.5, 1.0, 4.0])
def test_virtual_time_runs_at_the_pace_of_the_wall_clock(pace: float) -> None:
    scene = Scene(pace)
    begin = scene.wall.now
    for _ in range(3):
        scene.runner.run(0.773)
        assert scene.wall.now - begin == pytest.approx(scene.runner.now / pace)
    assert scene.runner.now == pytest.approx(3 * 0.773)
    assert scene.runner.lag == 0.0
    for steady, wall in scene.worker.ticks:
        assert wall - begin == pytest.approx(steady / pace)


def test_input_is_handled_at_the_time_of_the_wall_clock() -> None:
    scene = Scene()
    # Between two ticks: input wakes the waiting runner.
    for when in (0.503, 0.507):
        scene.wall.at(scene.wall.now + when, partial(scene.line.arrive, (when,)))
    scene.runner.run(1.0)
    assert len(scene.worker.received) == 2
    for sent, received in scene.worker.received:
        assert received == pytest.approx(sent, abs=1e-3)
    assert scene.line.sent == ["0.503 heard", "0.507 heard"]


@pytest.mark.parametrize("pace", [0.5, 1.0, 4.0])
def test_a_long_delay_is_lost_and_reported_and_no_time_is_skipped(pace: float) -> None:
    scene = Scene(pace)
    begin = scene.wall.now
    scene.worker.takes = [3.0]
    scene.runner.run(2.0 * pace)
    assert scene.runner.lag == pytest.approx(3.0, abs=SLACK)
    assert scene.wall.now - begin == pytest.approx(2.0 + scene.runner.lag)
    assert len(scene.worker.ticks) == pytest.approx(2.0 * pace / PERIOD, abs=1)
    # The needle does not speed up after the delay.
    late = [wall for steady, wall in scene.worker.ticks if steady > pace]
    assert late[-1] - late[0] == pytest.approx((len(late) - 1) * PERIOD / pace)


def test_input_during_a_delay_is_read_and_handled_right_after_it() -> None:
    scene = Scene()
    scene.worker.takes = [3.0]
    begin = scene.wall.now
    # A callable batch is evaluated when it is handled.
    for batch in (("stop",), lambda: (scene.wall.now,), tuple):
        scene.wall.at(begin + 1.0, partial(scene.line.arrive, batch))
    scene.runner.run(2.0)
    (what, when), (asked_at, _) = scene.worker.received
    assert what == "stop"
    assert when < 2.0 * PERIOD
    assert asked_at == pytest.approx(begin + 3.0, abs=SLACK)


def test_a_lost_port_is_reported_and_all_ports_are_closed() -> None:
    scene = Scene()
    scene.line.arrive(PortChange("unplugged"))
    scene.runner.run(0.1)
    assert scene.worker.changes == [PortChange("unplugged")]
    assert scene.line.is_open
    scene.runner.close()
    assert not scene.line.is_open
