"""hold.js with fingers, mouse and keys, in a real browser."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from campaign.trials.console.chromium import Chromium, chromium
from needle_console.hold.page_session import PageHold

pytest.importorskip("websockets", reason="the console's lock is not installed: scripts/console")

from campaign.trials.console.button_page import BUTTON, serve_button_page

pytestmark = [
    pytest.mark.skipif(chromium() is None, reason="no chromium: apt-get install chromium"),
]

TIMEOUT = 30.0
ELSEWHERE = (400.0, 300.0)
_STATE = "document.documentElement.dataset.holdState"


class Scene:
    """The page in a browser, and the states that the server reports."""

    def __init__(
        self,
        browser: Chromium,
        url: str,
        states: list[PageHold],
        counts: Callable[[], dict[str, int]],
    ):
        self.browser, self.tab = browser, browser.open(url)
        self.states = states
        self._counts = counts

    def until(self, condition: Callable[[], object], what: str) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, f"timed out: {what}"
            time.sleep(0.005)

    def until_released(self) -> None:
        self.until(lambda: not self.states[-1].pressed, "released")

    def wait_for_states(self, count: int) -> None:
        """Wait for a number of states."""
        enough = len(self.states) + count
        self.until(lambda: len(self.states) >= enough, "states")

    def hold(self, press: Callable[[], None], release: Callable[[], None]) -> None:
        """Press until the hold lasts: on a busy machine it may be lost at once."""
        deadline = time.monotonic() + TIMEOUT
        while True:
            assert time.monotonic() < deadline, "no press counts"
            release()
            self.until(lambda: self.tab.run(_STATE) in ("ready", "again"), "ready")
            press()
            self.wait_for_states(15)
            if self.states[-1].pressed:
                return

    def ends(
        self, hold: Callable[[], None], act: Callable[[], object], why: str | None = None
    ) -> None:
        """Check that an act ends a hold; repeat if a busy machine lost the hold before.

        The reason on the page must be `why`, if given.
        """
        deadline = time.monotonic() + TIMEOUT
        while True:
            assert time.monotonic() < deadline, "holds end by themselves alone"
            hold()
            lost = self._counts().get("hold lost", 0)
            act()
            self.until_released()
            if self._counts().get("hold lost", 0) == lost:
                assert why is None or self.why == why
                return

    @property
    def why(self) -> str:
        """Reason that the page gives for the end of the last hold."""
        return str(self.tab.run("needleHold.status.why"))

    def press_is_ignored(self, press: Callable[[], None]) -> bool:
        """Press, and return whether the press is ignored."""
        self.until(lambda: self.tab.run(_STATE) in ("ready", "again"), "ready")
        before = len(self.states)
        press()
        # The browser has processed the event when it answers.
        self.tab.run("0")
        self.wait_for_states(15)
        return not any(state.pressed for state in self.states[before:])

    def hold_pointer(self) -> None:
        self.hold(
            lambda: self.tab.press_pointer(*BUTTON), lambda: self.tab.release_pointer(*BUTTON)
        )

    def hold_space(self) -> None:
        self.hold(self.tab.press_space, self.tab.release_space)

    def hold_touch(self) -> None:
        self.hold(lambda: self.tab.touch(BUTTON), self.tab.touch)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    folder: Path = tmp_path_factory.mktemp("browser")
    states: list[PageHold] = []
    with serve_button_page(states.append, lambda _: None) as (page_port, hold):
        browser = Chromium(folder / "profile")
        try:
            url = f"http://127.0.0.1:{page_port}/?port={hold.port}"
            yield Scene(browser, url, states, hold.counts)
        finally:
            browser.close()


def test_mouse_space_bar_and_finger_hold_until_released(scene: Scene) -> None:
    tab = scene.tab
    scene.ends(scene.hold_pointer, lambda: tab.release_pointer(*BUTTON), "")
    scene.ends(scene.hold_space, tab.release_space, "")
    scene.ends(scene.hold_touch, tab.touch, "")


def test_a_second_finger_or_button_or_key_ends_a_hold(scene: Scene) -> None:
    tab = scene.tab
    second, elsewhere = "a second finger or mouse button", "the browser took the pointer away"
    scene.ends(scene.hold_touch, lambda: tab.touch(BUTTON, ELSEWHERE), f"hold ended: {second}")
    tab.touch()
    scene.ends(scene.hold_touch, tab.cancel_touch, f"hold ended: {elsewhere}")
    press = partial(tab.press_other_button, *BUTTON)
    scene.ends(scene.hold_pointer, press, f"hold ended: {second}")
    press = partial(tab.press_key, "Escape")
    scene.ends(scene.hold_space, press, "hold ended: another key was pressed")
    focus = partial(tab.run, "window.frames[0].focus()")
    scene.ends(scene.hold_pointer, focus, "hold ended: the window lost focus")
    tab.run("window.focus()")


def test_a_removed_button_or_page_ends_its_hold(scene: Scene) -> None:
    anew = "for (const old of document.querySelectorAll('button')) old.outerHTML = old.outerHTML"
    scene.ends(scene.hold_pointer, lambda: scene.tab.run(anew))
    # Its replacement is an identical button.
    scene.ends(scene.hold_pointer, lambda: scene.tab.release_pointer(*BUTTON))
    # A hidden page, and a closed one.
    browser, url = scene.browser, scene.tab.run("location.href")
    scene.ends(scene.hold_pointer, lambda: browser.open("about:blank"))
    browser.close_all_but(scene.tab)
    scene.tab.release_pointer(*BUTTON)
    other = browser.open(url)
    scene.tab, closed = other, scene.tab
    scene.ends(scene.hold_space, lambda: browser.close_all_but(closed))
    scene.tab = closed
    scene.tab.release_space()


def test_a_stalled_page_reports_it_until_the_next_press(scene: Scene) -> None:
    tab = scene.tab
    scene.hold_pointer()
    tab.run("const end = performance.now() + 500; while (performance.now() < end);")
    stalled = "hold ended: no echo from this page for 0.25 s (browser, network or console stalled)"
    scene.until(lambda: scene.why == stalled, "it says why")
    assert tab.run(_STATE) == "again"
    scene.hold_pointer()
    assert scene.why == ""
    tab.release_pointer(*BUTTON)
    scene.until_released()


def test_other_events_than_a_press_do_not_hold(scene: Scene) -> None:
    tab = scene.tab
    tab.release_space()
    assert scene.press_is_ignored(lambda: tab.press_space(repeat=True))
    tab.release_space()
    tab.run("document.querySelector('input').focus()")
    assert scene.press_is_ignored(tab.press_space)
    tab.release_space()
    tab.run("document.activeElement.blur()")
    tab.run("document.querySelector('[data-hold]').ariaDisabled = 'true'")
    assert scene.press_is_ignored(lambda: tab.press_pointer(*BUTTON))
    tab.release_pointer(*BUTTON)
    assert scene.press_is_ignored(tab.press_space)
    tab.release_space()
    tab.run("document.querySelector('[data-hold]').ariaDisabled = 'false'")
    assert scene.press_is_ignored(lambda: tab.press_pointer(*ELSEWHERE))
    tab.release_pointer(*ELSEWHERE)
