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
from needle_console.hold.hold_arbiter import MOST_PAGES
from needle_console.hold.hold_state import RELEASED, HoldState, Mode
from needle_core.errors import UserError

pytest.importorskip("websockets", reason="the console's lock is not installed: scripts/console")

from websockets.exceptions import ConnectionClosed, InvalidMessage, InvalidStatus
from websockets.sync.client import connect

from needle_console.hold import hold_talk
from needle_console.hold.hold_server import HoldServer

PAGE_PORT = 8080
ORIGIN = f"http://127.0.0.1:{PAGE_PORT}"
TOKEN = "correct horse battery"
PATIENCE = 20.0


def until(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain: {what}"
        time.sleep(0.002)


class Rig:
    """A server, and what it says."""

    def __init__(self, token: str = "") -> None:
        self.states: list[HoldState] = []
        self.notices: list[str] = []
        access = Access("127.0.0.1", PAGE_PORT, token)
        self.server = HoldServer(access, 0, self.states.append, self.notices.append)
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

    def open(self, token: str = "") -> Any:
        page = self.connect()
        page.send(json.dumps({"token": token}))
        return page


class HonestPage:
    """Echoes as hold.js does, in a thread of its own."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.pressed = False
        self.told: dict[str, Any] = {}
        self.sent: list[str] = []
        self._thread = threading.Thread(target=self._echo)
        self._thread.start()

    def close(self) -> None:
        self.page.close()
        self._thread.join()

    def _echo(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            for sequence, data in enumerate(self.page):
                self.told = json.loads(data)
                self.sent.append(
                    json.dumps(
                        {
                            "nonce": self.told["nonce"],
                            "sequence": sequence,
                            "pressed": self.pressed,
                            "speed": 0.5,
                            "mode": "insert",
                        }
                    )
                )
                self.page.send(self.sent[-1])


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.close()
    assert rig.states[-1] == RELEASED


@pytest.fixture
def honest(rig: Rig) -> Iterator[HonestPage]:
    page = HonestPage(rig.open())
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
    until(lambda: honest.told["owner"] == "you", "the page knows")
    release(rig, honest)


def test_closing_the_socket_releases_and_lets_another_page_hold(
    rig: Rig, honest: HonestPage
) -> None:
    other = HonestPage(rig.open())
    until(lambda: other.told, "a word of the server")
    press(rig, honest)
    until(lambda: other.told["owner"] == "other", "the other page knows")
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
    server = HoldServer(Access("127.0.0.1", PAGE_PORT), 0, states.append, print)
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
        # Who says no token is no page; to find that out takes the time of 50 words.
        rig.connect()
        until(lambda: rig.count("no token in time"), "refused")
        assert rig.states == [RELEASED]
        page = HonestPage(rig.open())
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
        HoldServer(Access("127.0.0.1", PAGE_PORT), rig.server.port, print, print)


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
        ({"path": "/hold?token=correct-horse-battery"}, "unknown path"),
    ],
)
def test_foreign_pages_are_refused_before_a_word(rig: Rig, how: dict[str, Any], kind: str) -> None:
    for _ in range(3):
        with pytest.raises(InvalidStatus) as refused:
            rig.connect(**how)
        assert refused.value.response.status_code == 403
    assert rig.server.counts() == {kind: 3}
    assert rig.notices == [f"hold: {kind}"]


def closing(page: Any) -> str:
    """Return why the server closes."""
    with pytest.raises(ConnectionClosed) as closed:
        while True:
            page.recv(timeout=PATIENCE)
    return closed.value.rcvd.reason if closed.value.rcvd is not None else "cut off"


def test_only_the_right_token_is_let_in() -> None:
    rig = Rig(TOKEN)
    try:
        for wrong in ("", TOKEN[:-1], TOKEN.upper()):
            assert closing(rig.open(wrong)) == "wrong token"
        # What would be a message later is no token.
        nobody = rig.connect()
        nobody.send("{}")
        assert closing(nobody) == "message not understood"
        assert rig.server.counts() == {"wrong token": 3, "message not understood": 1}
        assert sorted(rig.notices) == ["hold: message not understood", "hold: wrong token"]
        page = HonestPage(rig.open(TOKEN))
        until(lambda: page.told, "a word of the server")
        press(rig, page)
        page.close()
    finally:
        rig.close()


def test_who_says_no_token_is_not_waited_for(rig: Rig) -> None:
    assert closing(rig.connect()) == "no token in time"


def test_huge_frames_cut_off_who_sends_them(rig: Rig, honest: HonestPage) -> None:
    press(rig, honest)
    hostile = rig.open()
    hostile.send("x" * 10_000_000)
    closing(hostile)
    until(lambda: rig.count("message too long") == 1, "counted")
    release(rig, honest)


def test_a_flood_is_cut_off_and_the_right_page_ends_its_hold(rig: Rig, honest: HonestPage) -> None:
    press(rig, honest)
    cut_off = 0
    for _ in range(5):
        hostile = rig.open()
        with contextlib.suppress(ConnectionClosed):
            for _ in range(10_000):
                hostile.send('{"pressed": true}')
        cut_off += closing(hostile) == "cut off"
    assert cut_off == 5
    assert rig.count("too many messages") == 5
    assert rig.notices.count("hold: too many messages") == 1
    release(rig, honest)


def test_fifty_pages_at_once_do_not_keep_the_right_one_from_ending_its_hold(
    rig: Rig, honest: HonestPage
) -> None:
    press(rig, honest)
    pages = []
    refused = 0
    for _ in range(50):
        try:
            pages.append(rig.open())
        except (InvalidStatus, InvalidMessage):
            refused += 1
    until(
        lambda: (
            rig.count("too many pages") + rig.count("too many connections") == 50 - (MOST_PAGES - 1)
        ),
        "all but a few are refused",
    )
    assert len([line for line in rig.notices if "too many" in line]) <= 2
    release(rig, honest)
    for page in pages:
        page.close()


def test_nan_ends_the_hold_of_who_sends_it(rig: Rig, honest: HonestPage) -> None:
    press(rig, honest)
    honest.page.send(
        json.dumps({"nonce": honest.told["nonce"], "sequence": 10**6, "pressed": True})[:-1]
        + ', "speed": NaN, "mode": "insert"}'
    )
    until(lambda: rig.count("message not understood") == 1, "counted")
    until(lambda: not rig.pressed, "released")


def test_replayed_frames_move_nothing(rig: Rig, honest: HonestPage) -> None:
    press(rig, honest)
    release(rig, honest)
    honest.close()
    before = len(rig.states)
    replay = rig.open()
    for data in honest.sent[-20:]:
        replay.send(data)
    until(lambda: rig.count("unknown nonce") > 0, "counted")
    until(lambda: len(rig.states) > before + 10, "looked at")
    assert not any(state.pressed for state in rig.states[before:])
    replay.close()
