"""A page on a virtual line: the console's own talk tells what its finger does, or nothing."""

from __future__ import annotations

import itertools

import pytest

from needle_console.access.access import Access
from needle_console.hold.hold_state import HoldState, Mode
from needle_verification.soak.faults import PAGE_LINE
from needle_verification.soak.link_faults import LinkFault, LinkFaults
from needle_verification.soak.virtual_hold import VirtualHold
from needle_verification.soak.virtual_line import VirtualLine
from needle_verification.soak.virtual_page import VirtualPage
from needle_verification.soak.virtual_world import (
    NANOSECONDS,
    STEADY_START_NS,
    VirtualProcess,
    VirtualWorld,
)

ACCESS = Access("127.0.0.1", 8080, "", [])
LIFETIME = 0.25


class Scene:
    """A page and who serves its hold; `now` is seconds from its begin."""

    def __init__(self) -> None:
        self.world = VirtualWorld(1)
        self.faults = LinkFaults()
        self.finger = ""
        self.told: list[tuple[float, HoldState]] = []
        self.line = VirtualLine(self.world, self.faults)
        self.hold = self.serve()
        self.page = VirtualPage(self.world, self.line, lambda: self.finger)

    @property
    def now(self) -> float:
        return (self.world.steady_ns - STEADY_START_NS) / NANOSECONDS

    def serve(self) -> VirtualHold:
        def take(state: HoldState) -> None:
            self.told.append((self.now, state))

        process = VirtualProcess(self.world, "console", lambda _: None)
        hold = VirtualHold(process, self.line, ACCESS, take, lambda _: None)
        hold.start()
        return hold

    def go_on(self, seconds: float) -> None:
        self.world.run_until(self.world.steady_ns + round(seconds * NANOSECONDS))

    def press(self, button: str) -> None:
        self.finger = button
        self.go_on(0.05)

    def held_since(self, since: float) -> list[float]:
        """Return when it was told that somebody holds, from a time on."""
        return [at for at, state in self.told if at > since and state.pressed]


@pytest.fixture
def held() -> Scene:
    """Scene of a page that is held to insert."""
    scene = Scene()
    scene.go_on(0.5)
    scene.press("insert")
    return scene


def test_what_the_finger_does_is_told(held: Scene) -> None:
    assert held.told[-1][1] == HoldState(True, 1.0, Mode.INSERT)
    held.press("")
    assert not held.told[-1][1].pressed
    held.press("retract")
    assert held.told[-1][1] == HoldState(True, 1.0, Mode.RETRACT)


def test_a_finger_that_is_down_when_the_page_comes_holds_nothing() -> None:
    scene = Scene()
    scene.finger = "insert"
    scene.page.close()
    scene.page.open()
    scene.go_on(1.0)
    assert scene.held_since(0.0) == []
    scene.press("")
    scene.press("insert")
    assert scene.told[-1][1].pressed


def test_a_line_that_stands_still_ends_the_hold_and_it_does_not_come_back(held: Scene) -> None:
    begin = held.now
    held.faults.begin(PAGE_LINE, LinkFault(loss=1.0))
    held.go_on(1.0)
    assert held.page.asks_for_a_new_press
    held.faults.end(PAGE_LINE)
    held.go_on(1.0)
    assert held.held_since(begin)[-1] <= begin + LIFETIME
    assert held.page.asks_for_a_new_press
    held.press("")
    held.press("insert")
    assert held.told[-1][1].pressed


def test_a_hold_that_nobody_asks_for_takes_few_looks() -> None:
    # A time in seconds is rounded: a look must not be due for ever at the instant that it is.
    scene = Scene()
    scene.page.close()
    events = itertools.count()
    assert not scene.world.run_until(STEADY_START_NS + NANOSECONDS, lambda: next(events) > 1000)


def test_a_line_keeps_the_order_and_loses_nothing(held: Scene) -> None:
    heard: list[str] = []

    class End:
        def hear(self, text: str) -> None:
            heard.append(text)

        def see_end(self) -> None:
            heard.append("the end")

    held.line.accept = lambda _: End()
    connection = held.line.connect(held.page)
    held.faults.begin(PAGE_LINE, LinkFault(loss=0.5, late_ns=NANOSECONDS))
    sent = [str(number) for number in range(20)]
    for text in sent:
        connection.to_server.send(text)
    connection.to_server.close()
    held.go_on(30.0)
    assert heard == [*sent, "the end"]


def test_a_page_that_is_closed_ends_the_hold_at_once(held: Scene) -> None:
    begin = held.now
    held.page.close()
    held.go_on(0.5)
    assert not any(at > begin + 0.005 for at in held.held_since(begin))


def test_a_page_that_stands_still_lets_the_hold_end(held: Scene) -> None:
    begin = held.now
    held.page.freeze()
    held.go_on(0.5)
    held.finger = ""
    held.page.go_on()
    held.go_on(0.5)
    assert held.held_since(begin)[-1] <= begin + LIFETIME


@pytest.mark.parametrize("doing", ["sends_garbage", "repeats"])
def test_what_else_a_page_sends_makes_no_hold(held: Scene, doing: str) -> None:
    held.press("")
    begin = held.now
    setattr(held.page, doing, True)
    held.go_on(2.0)
    assert held.held_since(begin) == []
    assert sum(held.hold.counts().values()) > 50


def test_a_console_that_is_started_again_is_found_and_takes_a_new_press(held: Scene) -> None:
    begin = held.now
    held.hold.process.kill()
    held.hold.close()
    held.go_on(0.5)
    held.serve()
    held.go_on(2.0)
    assert held.held_since(begin) == []
    held.press("")
    held.press("insert")
    assert held.told[-1][1].pressed
