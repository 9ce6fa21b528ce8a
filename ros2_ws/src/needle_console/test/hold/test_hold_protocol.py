"""Rules of the console's hold (docs/safety.md)."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from hold_scene import Scene
from needle_console.hold.hold_protocol import IDLE, IDLE_PERIOD, OTHER_PAGE, PERIOD, SILENCE
from needle_console.hold.page_session import ECHO_AGE_LIMIT, RELEASED, HoldRefusal, Mode, PageHold

STALLED = "no echo from this page for 0.25 s (browser, network or console stalled)"
JUST = 1e-6


@pytest.fixture
def scene() -> Scene:
    return Scene()


@pytest.fixture
def page(scene: Scene) -> int:
    return scene.page()


def test_press_after_a_release_counts(scene: Scene, page: int) -> None:
    assert scene.send(page, True) is HoldRefusal.NEW_PRESS
    assert scene.protocol.state(scene.now) == RELEASED
    assert scene.send(page, False) is None
    assert scene.send(page, True, speed=0.25, mode="retract") is None
    assert scene.protocol.state(scene.now) == PageHold(True, 0.25, Mode.RETRACT)
    assert scene.send(page, True, speed=0.75, mode="retract") is None
    assert scene.protocol.state(scene.now).speed == 0.75
    assert scene.send(page, False) is None
    assert scene.protocol.state(scene.now) == RELEASED


def test_hold_lasts_while_echoed_and_ends_with_silence(scene: Scene, page: int) -> None:
    # docs/safety.md: 300 ms, including transport and a device cycle.
    assert ECHO_AGE_LIMIT + PERIOD < 0.3
    scene.press(page)
    for _ in range(20):
        scene.wait(ECHO_AGE_LIMIT - JUST)
        assert scene.pressed
        assert scene.send(page, True) is None
    scene.wait(ECHO_AGE_LIMIT + JUST)
    assert not scene.pressed
    assert scene.message_to(page)["why"] == STALLED
    # A continued press does not count, and the first reason stays.
    for _ in range(10):
        assert scene.send(page, True) is HoldRefusal.NEW_PRESS
        assert not scene.pressed
        assert scene.message_to(page)["why"] == STALLED
        scene.wait(PERIOD)
    assert scene.protocol.counts()["hold lost"] == 1
    scene.press(page)
    assert scene.message_to(page)["why"] == ""


def test_hold_age_counts_from_the_sent_count(scene: Scene, page: int) -> None:
    scene.press(page)
    begin, delayed = scene.now, []
    while scene.now + PERIOD < begin + ECHO_AGE_LIMIT:
        scene.wait(PERIOD)
        delayed.append((scene.message(page, True), scene.now))
    for data, _ in delayed:
        assert scene.protocol.receive(page, data, scene.now) is None
    _, last = delayed[-1]
    scene.wait(last + ECHO_AGE_LIMIT - JUST - scene.now)
    assert scene.pressed
    scene.wait(2.0 * JUST)
    assert not scene.pressed


@pytest.mark.parametrize("holds", [True, False])
@pytest.mark.parametrize("delayed", [[True] * 12, [False, True]])
def test_burst_after_a_stall_does_not_count(
    scene: Scene, page: int, delayed: list[bool], holds: bool
) -> None:
    if holds:
        scene.press(page)
    else:
        scene.send(page, False)
    messages = [scene.message(page, pressed) for pressed in delayed]
    scene.wait(ECHO_AGE_LIMIT + JUST)
    for data in messages:
        assert scene.protocol.receive(page, data, scene.now) is HoldRefusal.STALE
        assert not scene.pressed
    assert scene.send(page, True) is HoldRefusal.NEW_PRESS
    scene.press(page)


def test_echo_counts_once_except_for_a_release(scene: Scene, page: int) -> None:
    assert scene.send(page, False, count=1) is HoldRefusal.ECHO, "nothing was sent"
    scene.press(page)
    count = scene.count(page)
    assert scene.send(page, True, count=count + 1) is HoldRefusal.ECHO
    assert scene.send(page, True, count=count) is None
    assert scene.send(page, True, count=count) is HoldRefusal.ECHO
    assert scene.send(page, False, count=count) is None
    assert not scene.pressed
    assert scene.send(page, True, count=count) is HoldRefusal.ECHO
    assert scene.send(page, True) is HoldRefusal.NEW_PRESS
    assert scene.send(page, False, count=count) is HoldRefusal.ECHO


def test_echo_of_another_connection_does_not_count(scene: Scene, page: int) -> None:
    other = scene.page()
    scene.send(page, False)
    counts = [scene.count(which) for which in (page, other, page)]
    assert counts == sorted(set(counts))
    assert scene.send(page, True, count=counts[1]) is HoldRefusal.ECHO
    assert scene.send(page, False, count=counts[2]) is None
    # A reconnected page has to release first.
    scene.protocol.close(page, scene.now)
    again = scene.page()
    before = scene.count(again)
    assert scene.send(again, False, count=counts[2]) is HoldRefusal.ECHO
    assert scene.send(again, True, count=before) is HoldRefusal.NEW_PRESS


@pytest.mark.parametrize(
    ("act", "refusal"),
    [
        (lambda scene, page: scene.send(page, False, count=10**6), HoldRefusal.ECHO),
        (lambda scene, page: scene.send(page, True, mode="retract"), HoldRefusal.NEW_PRESS),
        (lambda scene, page: scene.protocol.receive(page, "{}", scene.now), HoldRefusal.INVALID),
        (lambda scene, page: scene.send(page, True, speed=float("nan")), HoldRefusal.INVALID),
    ],
)
def test_invalid_message_ends_the_hold(
    scene: Scene, page: int, act: Callable[[Scene, int], HoldRefusal | None], refusal: HoldRefusal
) -> None:
    scene.press(page)
    assert act(scene, page) is refusal
    assert not scene.pressed
    assert scene.send(page, True) is HoldRefusal.NEW_PRESS
    # It also invalidates an earlier release.
    scene.send(page, False)
    act(scene, page)
    assert scene.send(page, True) is HoldRefusal.NEW_PRESS
    scene.press(page)


@pytest.mark.parametrize("is_local", [True, False])
def test_barred_page_gets_the_reason(scene: Scene, is_local: bool) -> None:
    page = scene.page(is_local=is_local)
    scene.bars[not is_local] = "of no concern"
    scene.press(page)
    scene.bars[is_local] = "watching only"
    assert scene.send(page, True) is HoldRefusal.BARRED
    assert not scene.pressed
    message = scene.message_to(page)
    assert (message["bar"], message["why"]) == ("watching only", "watching only")
    scene.bars[is_local] = ""
    assert scene.send(page, True) is HoldRefusal.NEW_PRESS
    scene.press(page)


def test_page_owns_the_hold_until_it_disconnects_or_idles(scene: Scene) -> None:
    first, second, third = scene.page(), scene.page(), scene.page()
    scene.press(first)
    scene.send(first, False)
    assert scene.message_to(first)["bar"] == ""
    scene.send(second, False)
    assert scene.send(second, True) is HoldRefusal.BARRED
    assert scene.message_to(second)["why"] == OTHER_PAGE
    scene.protocol.close(first, scene.now)
    # A continued press does not count.
    assert scene.send(second, True) is HoldRefusal.NEW_PRESS
    scene.press(second)
    scene.send(second, False)
    scene.wait(IDLE)
    assert scene.message_to(third)["bar"] == OTHER_PAGE
    scene.wait(JUST)
    scene.press(third)
    assert scene.message_to(second)["bar"] == OTHER_PAGE
    # An earlier owner does not affect the hold; the owner ends it by disconnecting.
    scene.send(second, False)
    scene.protocol.close(second, scene.now)
    assert scene.pressed
    scene.protocol.close(third, scene.now)
    assert not scene.pressed


def test_owner_that_holds_is_not_idle(scene: Scene) -> None:
    first, second = scene.page(), scene.page()
    scene.press(first)
    for _ in range(round(IDLE / 0.2) + 2):
        scene.wait(0.2)
        assert scene.send(first, True) is None
    scene.send(second, False)
    assert scene.send(second, True) is HoldRefusal.BARRED
    assert scene.pressed


# ---- reports of the hold and of refusals


def update_until(scene: Scene, end: float) -> None:
    """Update at the requested times."""
    while scene.now < end:
        scene.now = scene.protocol.update(scene.now)


def test_hold_is_reported_every_20_ms_or_80_ms_without_a_page(scene: Scene) -> None:
    begin = scene.now
    update_until(scene, begin + 1.0)
    assert set(scene.reported) == {RELEASED}
    assert len(scene.reported) == pytest.approx(1.0 / IDLE_PERIOD, abs=1)
    # The first page shortens the period at once.
    scene.now = begin = scene.now + 0.1 * PERIOD - IDLE_PERIOD
    scene.page()
    assert scene.protocol.update(begin) <= begin + PERIOD
    scene.reported.clear()
    update_until(scene, begin + 1.0)
    assert len(scene.reported) == pytest.approx(1.0 / PERIOD, abs=1)


def test_changes_of_the_hold_are_reported_at_once(scene: Scene, page: int) -> None:
    for end in ("silence", "close"):
        update_until(scene, scene.now + 1.0)
        scene.press(page)
        begin = scene.now
        assert scene.reported[-1].pressed
        if end == "close":
            scene.protocol.close(page, begin)
        else:
            update_until(scene, begin + ECHO_AGE_LIMIT)
            assert scene.reported[-1].pressed
            update_until(scene, begin + ECHO_AGE_LIMIT + 1e-9)
            assert scene.now <= begin + ECHO_AGE_LIMIT + 1e-3
            scene.protocol.update(scene.now)
        assert scene.reported[-1] == RELEASED


def test_refusals_are_counted_and_logged_once(scene: Scene, page: int) -> None:
    for _ in range(3):
        scene.protocol.receive(page, "{", scene.now)
    scene.wait(SILENCE)
    scene.send(page, False)
    assert not scene.protocol.is_silent(page, scene.now + SILENCE)
    assert scene.protocol.is_silent(page, scene.now + SILENCE + JUST)
    assert scene.protocol.counts() == {"invalid message": 3, "silent page": 1}
    assert scene.notices == ["hold: invalid message", "hold: silent page"]
