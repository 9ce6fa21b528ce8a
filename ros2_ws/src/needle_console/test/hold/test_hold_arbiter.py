"""Whose press counts, and until when."""

from __future__ import annotations

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hold_scene import Scene
from needle_console.hold.hold_arbiter import IDLE, OTHER_PAGE, SILENCE
from needle_console.hold.hold_state import RELEASED, HoldState, Mode
from needle_console.hold.hold_talk import PERIOD
from needle_console.hold.page_session import ECHO_AGE_LIMIT
from needle_console.hold.refusals import Refusal
from needle_core.messages import HOLD_LIFETIME


def test_a_press_after_a_release_counts_with_its_speed_and_mode() -> None:
    scene = Scene()
    page = scene.page()
    assert scene.arbiter.state(scene.now) == RELEASED
    scene.say(page, False)
    assert scene.say(page, True, speed=0.25, mode="retract") is None
    assert scene.arbiter.state(scene.now) == HoldState(True, 0.25, Mode.RETRACT)
    assert scene.say(page, True, speed=0.75, mode="retract") is None
    assert scene.arbiter.state(scene.now).speed == 0.75
    assert scene.say(page, False) is None
    assert scene.arbiter.state(scene.now) == RELEASED


def test_a_page_that_comes_pressed_has_to_release_first() -> None:
    scene = Scene()
    page = scene.page()
    assert scene.say(page, True) is Refusal.NEW_PRESS
    assert not scene.pressed
    scene.press(page)


def test_a_hold_goes_on_while_it_is_confirmed_and_ends_with_silence() -> None:
    scene = Scene()
    page = scene.page()
    scene.press(page)
    for _ in range(100):
        scene.wait(0.9 * ECHO_AGE_LIMIT)
        assert scene.pressed
        assert scene.say(page, True) is None
    scene.wait(ECHO_AGE_LIMIT + 1e-6)
    assert not scene.pressed
    assert scene.arbiter.lapses(scene.now)
    assert not scene.arbiter.lapses(scene.now)
    # The finger that is still there counts for nothing.
    for _ in range(10):
        assert scene.say(page, True) is Refusal.NEW_PRESS
        assert not scene.pressed
        scene.wait(0.02)
    scene.press(page)


def test_a_hold_counts_from_its_echo_however_late_the_message_comes() -> None:
    scene = Scene()
    page = scene.page()
    scene.press(page)
    scene.wait(0.5 * ECHO_AGE_LIMIT)
    late = scene.message(page, True)
    scene.wait(0.4 * ECHO_AGE_LIMIT)
    assert scene.arbiter.receive(page, late, scene.now) is None
    scene.wait(0.59 * ECHO_AGE_LIMIT)
    assert scene.pressed
    scene.wait(0.02 * ECHO_AGE_LIMIT)
    assert not scene.pressed


def test_a_burst_after_a_stall_does_not_count() -> None:
    scene = Scene()
    page = scene.page()
    scene.press(page)
    held_up = []
    for _ in range(12):
        scene.wait(0.02)
        held_up.append(scene.message(page, True))
    scene.wait(ECHO_AGE_LIMIT)
    assert not scene.pressed
    for data in held_up:
        assert scene.arbiter.receive(page, data, scene.now) is not None
        assert not scene.pressed
    assert scene.say(page, True) is Refusal.NEW_PRESS


def test_a_page_that_stalls_for_almost_the_limit_goes_on() -> None:
    scene = Scene()
    page = scene.page()
    scene.press(page)
    held_up = []
    while scene.now + PERIOD < 100.0 + ECHO_AGE_LIMIT:
        scene.wait(PERIOD)
        held_up.append(scene.count(page))
    for count in held_up:
        assert scene.say(page, True, count=count) is None
        assert scene.pressed
    # The last of them counts from when it was sent.
    scene.wait(ECHO_AGE_LIMIT + 1e-6)
    assert not scene.pressed


def test_the_page_is_told_why_its_press_ended_until_it_is_let_go() -> None:
    scene = Scene()
    page = scene.page()
    scene.press(page)
    scene.wait(ECHO_AGE_LIMIT + 1e-6)
    assert scene.arbiter.lapses(scene.now)
    stalled = "no echo from this page for 0.25 s (browser, network or console stalled)"
    assert scene.arbiter.tell(page, scene.now)["why"] == stalled
    # What the finger that is still there meets now is not why.
    assert scene.say(page, True) is Refusal.NEW_PRESS
    assert scene.arbiter.tell(page, scene.now)["why"] == stalled
    scene.say(page, False)
    assert scene.arbiter.tell(page, scene.now)["why"] == ""
    scene.say(page, True)
    assert scene.arbiter.tell(page, scene.now)["why"] == ""


def test_the_bound_of_a_page_is_kept_and_its_message_promises_no_more_than_any_other() -> None:
    # A web page's hold ends within 300 ms, transport and cycle included; what a hold message
    # promises is another thing.
    assert ECHO_AGE_LIMIT + PERIOD < 0.3
    assert HOLD_LIFETIME == 0.1


def test_a_release_and_press_within_a_stall_do_not_count() -> None:
    scene = Scene()
    page = scene.page()
    scene.press(page)
    release, press = scene.message(page, False), scene.message(page, True)
    scene.wait(ECHO_AGE_LIMIT + 1e-6)
    assert scene.arbiter.receive(page, release, scene.now) is Refusal.STALE
    assert scene.arbiter.receive(page, press, scene.now) is Refusal.STALE
    assert scene.say(page, True) is Refusal.NEW_PRESS
    assert not scene.pressed


def test_a_press_that_is_too_old_when_it_comes_does_not_count_later() -> None:
    scene = Scene()
    page = scene.page()
    scene.say(page, False)
    press = scene.message(page, True)
    scene.wait(ECHO_AGE_LIMIT + 1e-6)
    assert scene.arbiter.receive(page, press, scene.now) is Refusal.STALE
    assert scene.say(page, True) is Refusal.NEW_PRESS


def test_an_echo_counts_once_and_a_release_may_repeat_the_last() -> None:
    scene = Scene()
    page = scene.page()
    scene.press(page)
    count = scene.count(page)
    assert scene.say(page, True, count=count) is None
    assert scene.say(page, True, count=count) is Refusal.ECHO
    assert scene.say(page, False, count=count) is None
    assert not scene.pressed
    assert scene.say(page, True, count=count) is Refusal.ECHO
    # A press that did not count when it came does not count later.
    assert scene.say(page, True) is Refusal.NEW_PRESS
    assert scene.say(page, False, count=count) is Refusal.ECHO
    scene.press(page)


def test_an_echo_of_another_connection_does_not_count() -> None:
    scene = Scene()
    page, other = scene.page(), scene.page()
    scene.say(page, False)
    counts = [scene.count(which) for which in (page, other, page)]
    assert counts == sorted(set(counts))
    assert scene.say(page, True, count=counts[1]) is Refusal.ECHO
    assert scene.say(page, False, count=counts[2]) is None
    # One that comes again begins with counts of its own.
    scene.arbiter.close(page)
    again = scene.page()
    before = scene.count(again)
    assert scene.say(again, False, count=counts[2]) is Refusal.ECHO
    assert scene.say(again, True, count=before) is Refusal.NEW_PRESS
    assert not scene.pressed


def test_an_echo_above_the_newest_count_does_not_count_and_spoils_nothing() -> None:
    scene = Scene()
    page = scene.page()
    assert scene.say(page, False, count=1) is Refusal.ECHO, "nothing was sent"
    scene.press(page)
    count = scene.count(page)
    assert scene.say(page, True, count=count + 1) is Refusal.ECHO
    assert scene.say(page, True, count=count) is None


@pytest.mark.parametrize("is_local", [True, False])
def test_a_barred_page_holds_nothing_and_is_told_why(is_local: bool) -> None:
    scene = Scene()
    page = scene.page(is_local=is_local)
    scene.press(page)
    scene.bars[is_local] = "only watching"
    scene.say(page, True)
    assert not scene.pressed
    told = scene.arbiter.tell(page, scene.now)
    assert (told["bar"], told["why"]) == ("only watching", "only watching")
    scene.bars[is_local] = ""
    assert scene.say(page, True) is Refusal.NEW_PRESS
    scene.press(page)


def test_a_release_ends_a_hold_even_if_it_does_not_count() -> None:
    scene = Scene()
    page = scene.page()
    scene.press(page)
    assert scene.say(page, False, count=10**6) is Refusal.ECHO
    assert not scene.pressed
    assert scene.say(page, True) is Refusal.NEW_PRESS


@pytest.mark.parametrize("data", ["", "{}", b"\0", '{"speed": NaN}'])
def test_garbage_ends_a_hold(data: str | bytes) -> None:
    scene = Scene()
    page = scene.page()
    scene.press(page)
    assert scene.arbiter.receive(page, data, scene.now) is Refusal.GARBAGE
    assert not scene.pressed
    assert scene.say(page, True) is Refusal.NEW_PRESS
    # And what was heard before it.
    scene.say(page, False)
    scene.arbiter.receive(page, data, scene.now)
    assert scene.say(page, True) is Refusal.NEW_PRESS


def test_another_mode_takes_another_press() -> None:
    scene = Scene()
    page = scene.page()
    scene.press(page)
    assert scene.say(page, True, mode="retract") is Refusal.NEW_PRESS
    assert not scene.pressed
    assert scene.say(page, True, mode="retract") is Refusal.NEW_PRESS
    scene.press(page)


def test_one_page_owns_the_hold_until_it_is_gone_or_idle() -> None:
    scene = Scene()
    first, second = scene.page(), scene.page()
    scene.press(first)
    scene.say(first, False)
    assert scene.arbiter.tell(first, scene.now)["bar"] == ""
    assert scene.arbiter.tell(second, scene.now)["bar"] == OTHER_PAGE
    scene.say(second, False)
    assert scene.say(second, True) is Refusal.BARRED
    assert scene.arbiter.tell(second, scene.now)["why"] == "another page steers"
    scene.arbiter.close(first)
    # The finger that is still there counts for nothing.
    assert scene.say(second, True) is Refusal.NEW_PRESS
    scene.press(second)
    scene.say(second, False)
    third = scene.page()
    scene.wait(IDLE + 1e-6)
    assert scene.arbiter.tell(third, scene.now)["bar"] == ""
    scene.press(third)
    assert scene.arbiter.tell(second, scene.now)["bar"] == OTHER_PAGE
    # What the earlier owner says or does is nothing to the hold.
    scene.say(second, False)
    scene.arbiter.close(second)
    assert scene.pressed


def test_a_page_that_goes_takes_its_hold_along() -> None:
    scene = Scene()
    page = scene.page()
    scene.press(page)
    scene.arbiter.close(page)
    assert not scene.pressed


def test_a_page_is_gone_when_it_is_silent() -> None:
    scene = Scene()
    page = scene.page()
    scene.wait(SILENCE)
    assert not scene.arbiter.is_silent(page, scene.now)
    scene.wait(1e-6)
    assert scene.arbiter.is_silent(page, scene.now)
    scene.say(page, False)
    assert not scene.arbiter.is_silent(page, scene.now)


# ---- whatever comes ------------------------------------------------------------------------------

PAGES = 2
ACTIONS = st.one_of(
    # An honest page: a count goes out, its echo comes back after so long.
    st.tuples(st.just("echo"), st.integers(0, PAGES - 1), st.booleans(), st.floats(0.0, 0.05)),
    st.tuples(st.just("echo"), st.integers(0, PAGES - 1), st.booleans(), st.floats(0.0, 0.3)),
    st.tuples(st.just("wait"), st.integers(0, 0), st.booleans(), st.floats(0.0, 0.3)),
    # A message is written, but comes at some later time, more than once, to any page.
    st.tuples(st.just("write"), st.integers(0, PAGES - 1), st.booleans(), st.floats(0.0, 0.0)),
    st.tuples(st.just("replay"), st.integers(0, PAGES - 1), st.booleans(), st.floats(0.0, 1.0)),
    st.tuples(st.just("garbage"), st.integers(0, PAGES - 1), st.booleans(), st.floats(0.0, 0.0)),
    st.tuples(st.just("reload"), st.integers(0, PAGES - 1), st.booleans(), st.floats(0.0, 0.0)),
)


class Witness(Scene):
    """Keeps a record of its own, and judges each hold by it."""

    def __init__(self) -> None:
        super().__init__()
        self.pages = [self.page() for _ in range(PAGES)]
        self.written: list[str] = []
        # Count -> the page that it went to, and when.
        self._sent: dict[int, tuple[int, float]] = {}
        # By page: highest count echoed; when the newest count of a pressed message was sent; at
        # which event a fresh release was heard, and at which a hold was over.
        self._heard: dict[int, int] = {}
        self._proof: dict[int, float] = {}
        self._released: dict[int, int] = {}
        self._over: dict[int, int] = {}
        self._event = 0
        self._holder: int | None = None

    def write(self, page: int, pressed: bool) -> str:
        count = self.count(page)
        self._sent[count] = page, self.now
        data = self.message(page, pressed, count)
        self.written.append(data)
        return data

    def deliver(self, page: int, data: str) -> None:
        self.look()
        fields = json.loads(data)
        to_page, sent = self._sent[fields["count"]]
        before = self._heard.get(page, 0)
        if to_page == page and fields["count"] >= before:
            if fields["pressed"] and fields["count"] > before:
                self._proof[page] = max(self._proof.get(page, -1.0), sent)
            elif not fields["pressed"] and self.now - sent <= ECHO_AGE_LIMIT:
                self._released[page] = self._event
            self._heard[page] = fields["count"]
        self.arbiter.receive(page, data, self.now)
        self.look()

    def look(self) -> None:
        """Look at the hold now, and judge it."""
        holders = [page for page in self.pages if self.arbiter.tell(page, self.now)["held"]]
        assert len(holders) == self.pressed
        holder = holders[0] if holders else None
        if holder is not None:
            # Somebody pressed this page's button no longer ago than that, by our own clock.
            assert self.now - self._proof[holder] <= ECHO_AGE_LIMIT
            if self._holder is None:
                # And it was seen released since its last hold was over.
                assert self._released[holder] >= self._over.get(holder, -1)
            else:
                assert holder == self._holder
        elif self._holder is not None:
            self._over[self._holder] = self._event
        self._holder = holder
        self._event += 1


@settings(max_examples=300, deadline=None, derandomize=True)
@given(st.lists(ACTIONS, min_size=5, max_size=60))
def test_nothing_resumes_by_itself_whatever_comes(
    actions: list[tuple[str, int, bool, float]],
) -> None:
    scene = Witness()
    for action, number, pressed, amount in actions:
        page = scene.pages[number]
        data: str | None = None
        if action == "echo":
            data = scene.write(page, pressed)
            scene.wait(amount)
        elif action == "wait":
            scene.wait(amount)
        elif action == "write":
            scene.write(page, pressed)
        elif action == "replay" and scene.written:
            data = scene.written[int(amount * (len(scene.written) - 1))]
        elif action == "garbage":
            scene.arbiter.receive(page, "{", scene.now)
        elif action == "reload":
            scene.arbiter.close(page)
            scene.pages[number] = scene.page()
        if data is not None:
            scene.deliver(scene.pages[number], data)
        scene.look()
