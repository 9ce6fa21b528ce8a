"""The paced runner on a wall clock of the test's own: pace, lag, what comes from outside."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import pytest

from needle_core.component import Actions, Component, Moment, Port, Send, Timer
from needle_core.runners.paced import SLACK, PacedRunner
from wall_clock import WallClock

PERIOD = 0.02


class Worker(Component):
    """Takes time of the wall clock now and then, and notes what comes in through its port."""

    name = "worker"

    def __init__(self, wall: WallClock) -> None:
        self.wall = wall
        self.takes: list[float] = []
        self.ticks: list[tuple[float, float]] = []
        self.heard: list[tuple[Any, float]] = []
        self.ports = (Port("outside", self._hear),)
        self.timers = (Timer(PERIOD, self._tick),)

    def _hear(self, batch: Sequence[Any], at: Moment) -> Actions:
        self.heard += [(item, at.steady) for item in batch]
        yield Send("outside", tuple(f"{item} heard" for item in batch))

    def _tick(self, at: Moment) -> Actions:
        self.ticks.append((at.steady, self.wall.now))
        if self.takes:
            self.wall.spend(self.takes.pop(0))
        return ()


class Line:
    """What is outside."""

    def __init__(self, wall: WallClock) -> None:
        self.wall = wall
        self.coming: list[Any] = []
        self.sent: list[Any] = []

    def say(self, item: Any) -> None:
        self.coming.append(item)
        self.wall.set()

    def take(self) -> Sequence[Any]:
        coming, self.coming = self.coming, []
        return coming

    def send(self, batch: Sequence[Any]) -> None:
        self.sent += batch


class Scene:
    def __init__(self, pace: float = 1.0) -> None:
        self.wall = WallClock()
        self.worker, self.line = Worker(self.wall), Line(self.wall)
        self.runner = PacedRunner(
            [self.worker],
            pace=pace,
            outside={"outside": self.line},
            bell=self.wall,
            clock=self.wall,
        )


@pytest.mark.parametrize("pace", [0.5, 1.0, 4.0])
def test_virtual_time_goes_at_the_pace_of_the_wall_clock(pace: float) -> None:
    scene = Scene(pace)
    begin = scene.wall.now
    for _ in range(5):
        scene.runner.run(1.0)
    assert scene.wall.now - begin == pytest.approx(5.0 / pace)
    assert scene.runner.lag == 0.0
    for steady, wall in scene.worker.ticks:
        assert wall - begin == pytest.approx(steady / pace)


def test_what_comes_in_is_handled_at_the_moment_that_the_wall_clock_shows() -> None:
    scene = Scene()
    # Between two ticks: whoever waits for the next one is woken.
    for when in (0.503, 0.507):
        scene.wall.at(scene.wall.now + when, partial(scene.line.say, when))
    scene.runner.run(1.0)
    assert len(scene.worker.heard) == 2
    for said, heard in scene.worker.heard:
        assert heard == pytest.approx(said, abs=1e-3)
    assert scene.line.sent == ["0.503 heard", "0.507 heard"]


def test_a_short_delay_is_made_up_for() -> None:
    scene = Scene()
    begin = scene.wall.now
    scene.worker.takes = [0.8 * SLACK]
    scene.runner.run(2.0)
    assert scene.runner.lag == 0.0
    assert scene.wall.now - begin == pytest.approx(2.0)


def test_a_long_delay_is_lost_and_told_and_no_time_is_skipped() -> None:
    scene = Scene()
    begin = scene.wall.now
    scene.worker.takes = [3.0]
    scene.runner.run(2.0)
    assert scene.runner.lag == pytest.approx(3.0, abs=SLACK)
    assert scene.wall.now - begin == pytest.approx(2.0 + scene.runner.lag)
    assert len(scene.worker.ticks) == pytest.approx(2.0 / PERIOD, abs=1)
    # After the delay the needle goes no faster than before.
    late = [wall for steady, wall in scene.worker.ticks if steady > 1.0]
    assert late[-1] - late[0] == pytest.approx((len(late) - 1) * PERIOD)


def test_what_comes_in_during_a_delay_is_handled_right_after_it() -> None:
    scene = Scene()
    scene.worker.takes = [3.0]
    scene.wall.at(scene.wall.now + 1.0, lambda: scene.line.say("stop"))
    scene.runner.run(2.0)
    ((what, when),) = scene.worker.heard
    assert what == "stop"
    assert when < 2.0 * PERIOD
