"""The hold over real sockets: an honest page, and whatever else connects."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from needle_console.access.access import Access
from needle_console.hold.hold_arbiter import OTHER_PAGE
from needle_console.hold.hold_state import RELEASED, HoldState, Mode
from needle_core.errors import UserError

pytest.importorskip("websockets", reason="the console's lock is not installed: scripts/console")

from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from needle_console.hold import hold_talk
from needle_console.hold.hold_server import HoldServer

PAGE_PORT = 8080
ORIGIN = f"http://127.0.0.1:{PAGE_PORT}"
PATIENCE = 20.0


def until(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain: {what}"
        time.sleep(0.002)


class Rig:
    """A server, and what it says."""

    def __init__(self) -> None:
        self.states: list[HoldState] = []
        self.notices: list[str] = []
        # Why a page may not hold, by whether it is on this machine.
        self.bars = {True: "", False: ""}
        self.server = HoldServer(
            Access("127.0.0.1", PAGE_PORT),
            0,
            lambda is_local: self.bars[is_local],
            self.states.append,
            self.notices.append,
        )
        self.server.start()
        self._open = contextlib.ExitStack()

    def close(self) -> None:
        self.server.close()
        self._open.close()

    @property
    def pressed(self) -> bool:
        return bool(self.states) and self.states[-1].pressed

    def count(self, kind: str) -> int:
        return self.server.counts().get(kind, 0)

    def connect(
        self, *, host: str = "127.0.0.1", origin: str | None = ORIGIN, path: str = "/hold"
    ) -> Any:
        plain = socket.create_connection(("127.0.0.1", self.server.port))
        address = f"ws://{host}:{self.server.port}{path}"
        return self._open.enter_context(
            connect(address, sock=plain, origin=origin, compression=None)
        )


class HonestPage:
    """Echoes as hold.js does, in a thread of its own."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.pressed = False
        self.told: dict[str, Any] = {}
        self._thread = threading.Thread(target=self._echo)
        self._thread.start()

    def close(self) -> None:
        self.page.close()
        self._thread.join()

    def _echo(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            for data in self.page:
                self.told = json.loads(data)
                fields = {"count": self.told["count"], "pressed": self.pressed}
                self.page.send(json.dumps({**fields, "speed": 0.5, "mode": "insert"}))


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.close()
    assert rig.states[-1] == RELEASED


@pytest.fixture
def honest(rig: Rig) -> Iterator[HonestPage]:
    page = HonestPage(rig.connect())
    until(lambda: page.told, "a word of the server")
    yield page
    page.close()


def has_heard(page: HonestPage, count: int) -> Callable[[], bool]:
    """Return what tells whether the server has heard so many more messages of a page."""
    enough = page.told["heard"] + count
    return lambda: page.told["heard"] >= enough


def press(rig: Rig, page: HonestPage) -> None:
    """Press until it counts: on a busy machine a hold may be lost at once."""
    deadline = time.monotonic() + PATIENCE
    while not rig.pressed:
        assert time.monotonic() < deadline, f"no press counts: {page.told}"
        page.pressed = False
        until(has_heard(page, 2), "a release is heard")
        page.pressed = True
        heard = has_heard(page, 6)
        while not (rig.pressed or heard()):
            time.sleep(0.002)


def release(rig: Rig, page: HonestPage) -> None:
    page.pressed = False
    until(lambda: not rig.pressed, "released")


def test_a_hold_is_handed_on_and_released(rig: Rig, honest: HonestPage) -> None:
    press(rig, honest)
    assert HoldState(True, 0.5, Mode.INSERT) in rig.states
    until(lambda: honest.told["held"], "the page knows")
    release(rig, honest)


def test_closing_the_socket_releases_and_lets_another_page_hold(
    rig: Rig, honest: HonestPage
) -> None:
    other = HonestPage(rig.connect())
    until(lambda: other.told, "a word of the server")
    press(rig, honest)
    until(lambda: other.told["bar"] == OTHER_PAGE, "the other page knows")
    honest.close()
    until(lambda: not rig.pressed, "released")
    press(rig, other)
    other.close()


def test_the_end_of_the_server_releases(rig: Rig, honest: HonestPage) -> None:
    press(rig, honest)
    rig.server.close()
    assert rig.states[-1] == RELEASED
    assert not rig.server.is_alive


def test_an_end_before_the_first_word_hands_on_a_release_all_the_same() -> None:
    states: list[HoldState] = []
    server = HoldServer(Access("127.0.0.1", PAGE_PORT), 0, lambda _: "", states.append, print)
    server._end()
    server.start()
    server.close()
    assert states == [RELEASED]


def test_without_a_page_the_release_is_only_repeated_and_the_first_page_wakes_the_server(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(hold_talk, "ALONE_PERIOD", 3600.0)
    rig = Rig()
    try:
        until(lambda: rig.states, "a release")
        # The time of 15 words.
        time.sleep(0.3)
        assert rig.states == [RELEASED]
        page = HonestPage(rig.connect())
        try:
            until(lambda: page.told, "a word of the server")
            press(rig, page)
            enough = len(rig.states) + 5
            until(lambda: len(rig.states) >= enough, "states")
        finally:
            page.close()
        until(lambda: not rig.pressed, "released")
    finally:
        rig.close()


def test_a_port_that_is_taken_is_said(rig: Rig) -> None:
    with pytest.raises(UserError, match=rf"hold: 127.0.0.1 port {rig.server.port}: "):
        HoldServer(Access("127.0.0.1", PAGE_PORT), rig.server.port, lambda _: "", print, print)


@pytest.mark.parametrize(
    ("how", "kind"),
    [
        ({"host": "evil.example"}, "foreign Host"),
        ({"origin": "http://evil.example"}, "foreign Origin"),
        ({"origin": f"http://evil.example:{PAGE_PORT}"}, "foreign Origin"),
        ({"origin": "http://127.0.0.1:1"}, "foreign Origin"),
        ({"origin": "null"}, "foreign Origin"),
        ({"origin": None}, "foreign Origin"),
        ({"path": "/"}, "unknown path"),
        ({"path": "/hold?a=b"}, "unknown path"),
    ],
)
def test_foreign_pages_are_refused_before_a_word(rig: Rig, how: dict[str, Any], kind: str) -> None:
    for _ in range(3):
        with pytest.raises(InvalidStatus) as refused:
            rig.connect(**how)
        assert refused.value.response.status_code == 403
    assert rig.server.counts() == {kind: 3}
    assert rig.notices == [f"hold: {kind}"]


def test_nan_ends_the_hold_of_who_sends_it(rig: Rig, honest: HonestPage) -> None:
    press(rig, honest)
    honest.page.send(
        json.dumps({"count": honest.told["count"], "pressed": True})[:-1]
        + ', "speed": NaN, "mode": "insert"}'
    )
    until(lambda: rig.count("message not understood") == 1, "counted")
    until(lambda: not rig.pressed, "released")


def test_a_page_on_this_machine_is_local_and_one_that_is_barred_ends_its_hold(
    rig: Rig, honest: HonestPage
) -> None:
    rig.bars = {True: "", False: "only watching"}
    press(rig, honest)
    rig.bars = {True: "only watching", False: ""}
    until(lambda: not rig.pressed, "released")
    until(lambda: honest.told["why"] == "only watching", "the page knows")
    assert honest.told["bar"] == "only watching"
