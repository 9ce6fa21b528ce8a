"""Messages to pages, and the reports of the hold."""

from __future__ import annotations

import pytest

from hold_scene import Scene
from needle_console.hold.hold_protocol import IDLE_PERIOD, PERIOD, SILENCE
from needle_console.hold.page_session import ECHO_AGE_LIMIT, RELEASED


def update_until(scene: Scene, end: float) -> None:
    """Update at the requested times."""
    while scene.now < end:
        scene.now = scene.protocol.update(scene.now)


def test_hold_is_reported_every_20_ms_or_80_ms_without_a_page() -> None:
    scene = Scene()
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


def test_changes_of_the_hold_are_reported_at_once() -> None:
    scene = Scene()
    page = scene.page()
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


def test_refusals_are_counted_and_logged_once() -> None:
    scene = Scene()
    page = scene.page()
    for _ in range(3):
        scene.protocol.receive(page, "{", scene.now)
    scene.wait(SILENCE)
    scene.send(page, False)
    assert not scene.protocol.is_silent(page, scene.now + SILENCE)
    assert scene.protocol.is_silent(page, scene.now + SILENCE + 1e-6)
    assert scene.protocol.counts() == {"invalid message": 3, "silent page": 1}
    assert scene.notices == ["hold: invalid message", "hold: silent page"]
