"""A page's hold on a simulation that lags: it ages on the wall clock, not in virtual time."""

from __future__ import annotations

import json
from collections.abc import Callable

from needle_console.console import PAGE, Console
from needle_console.console_parameters import ConsoleParameters
from needle_console.hold.hold_talk import HoldTalk
from needle_console.hold.page_session import ECHO_AGE_LIMIT
from needle_console.page.desk import Desk
from needle_core import messages as m
from needle_core.component import Actions, Component, Input, Moment, Timer
from needle_core.runners.paced import PacedRunner
from wall_clock import WallClock

CYCLE, TAKES = 0.02, 0.2
"""A cycle of the simulated device, and how long it takes this slow computer [s]."""
ECHO_PERIOD = 0.1
"""A page echoes so often by the wall clock: no flood on a slower one, either [s]."""


class SlowDevice(Component):
    """Simulates ten times slower than real time, and notes when it hears a hold."""

    name = "slow_device"

    def __init__(self, wall: WallClock) -> None:
        self.wall = wall
        self.takes = TAKES
        self.pressed_at: list[float] = []
        self.inputs = (Input("device/hold", m.HoldState, self._on_hold),)
        self.timers = (Timer(CYCLE, self._cycle),)

    def _cycle(self, at: Moment) -> Actions:
        self.wall.spend(self.takes)
        return ()

    def _on_hold(self, message: m.HoldState, at: Moment) -> Actions:
        if message.pressed:
            self.pressed_at.append(self.wall.now)
        return ()


class Scene:
    """A page that holds, the hold's server, the console and a slow device.

    `age` makes the clock on which holds age: that of the wall, unless a bug is planted.
    """

    def __init__(self, age: Callable[[Scene], float] | None = None) -> None:
        self.wall = WallClock()
        self.device = SlowDevice(self.wall)
        self.echoes = self.is_held = True
        self._age = age
        self.desk = Desk(ConsoleParameters(), self.now)
        self.runner = PacedRunner(
            [self.device, Console(ConsoleParameters())],
            ports={PAGE: self.desk},
            bell=self.wall,
            clock=self.wall,
        )
        self.talk = HoldTalk(lambda _: "", self.desk.hold, self.desk.notice, self.now())
        self._page = self.talk.open(self.now(), is_local=True)
        self._echo(pressed=False)
        self.wall.every(ECHO_PERIOD, self._serve)

    def now(self) -> float:
        return self._age(self) if self._age else self.wall.now

    def _serve(self) -> None:
        """Do what the hold's server and the page do."""
        if self.echoes:
            self._echo(pressed=self.is_held)
        self.talk.look(self.now())

    def _echo(self, *, pressed: bool) -> None:
        count = json.loads(self.talk.word_for(self._page, self.now()))["count"]
        message = {"count": count, "pressed": pressed, "speed": 0.5, "mode": "insert"}
        self.talk.hear(self._page, json.dumps(message), self.now())

    def forward(self, seconds: float) -> None:
        """Let time of the wall clock go by."""
        end = self.wall.now + seconds
        while self.wall.now < end:
            self.runner.run(CYCLE)


def hold_after_silence(scene: Scene) -> float:
    """Return for how long a hold goes on once its page has fallen silent [s]."""
    scene.forward(10.0)
    assert scene.device.pressed_at
    assert scene.runner.lag > 5.0
    scene.echoes, silent_at = False, scene.wall.now
    scene.forward(10.0)
    return scene.device.pressed_at[-1] - silent_at


def virtual(scene: Scene) -> float:
    """Return the time on which a planted bug lets holds age."""
    return scene.runner.now if hasattr(scene, "runner") else 0.0


def test_a_hold_ends_by_the_wall_clock_where_virtual_time_lags() -> None:
    assert hold_after_silence(Scene()) < ECHO_AGE_LIMIT + 2.0 * TAKES


def test_a_hold_that_ages_on_virtual_time_is_found() -> None:
    assert hold_after_silence(Scene(virtual)) > ECHO_AGE_LIMIT + 5.0 * TAKES


def test_a_release_ends_a_hold_at_once_where_virtual_time_lags() -> None:
    scene = Scene()
    scene.forward(10.0)
    scene.is_held, released_at = False, scene.wall.now
    scene.forward(10.0)
    assert scene.device.pressed_at[-1] < released_at + 2.0 * TAKES
    assert scene.device.pressed_at[-1] > 9.0
