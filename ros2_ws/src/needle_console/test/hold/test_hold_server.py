"""Server of the hold: access control, and the end of a connection."""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from needle_console.access import Access
from needle_console.hold.page_session import RELEASED, PageHold
from needle_core.errors import UserError

pytest.importorskip("websockets", reason="the console's lock is not installed: scripts/console")

from websockets.datastructures import Headers
from websockets.http11 import Request

from needle_console.hold import hold_server
from needle_console.hold.hold_server import HoldServer

HOST, ORIGIN = ("Host", "127.0.0.1:8081"), ("Origin", "http://127.0.0.1:8080")


class Rig:
    """A server with a stopped clock that records its reports."""

    def __init__(self) -> None:
        self.states: list[PageHold] = []
        self.notices: list[str] = []
        self.asked: list[bool] = []
        self.server = HoldServer(
            Access("127.0.0.1", 8080),
            0,
            self.refusal_reason,
            self.states.append,
            self.notices.append,
        )

    def refusal_reason(self, is_local: bool) -> str:
        self.asked.append(is_local)
        return ""


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    monkeypatch.setattr(hold_server, "time", SimpleNamespace(monotonic=lambda: 100.0))
    monkeypatch.setattr(hold_server, "PERIOD", 0.0)
    rig = Rig()
    yield rig
    rig.server.close()


class Page:
    """A connection that echoes counts, then closes."""

    def __init__(self, *pressed: bool, address: str = "127.0.0.1") -> None:
        self.local_address, self.remote_address = ("127.0.0.1", 1), (address, 2)
        self._pressed = deque(pressed)
        self._words: asyncio.Queue[str] = asyncio.Queue()

    async def send(self, word: str) -> None:
        await self._words.put(word)

    def __aiter__(self) -> Page:
        return self

    async def __anext__(self) -> str:
        if not self._pressed:
            raise StopAsyncIteration
        count = json.loads(await self._words.get())["count"]
        fields = {"count": count, "pressed": self._pressed.popleft()}
        return json.dumps({**fields, "speed": 0.5, "mode": "insert"})


@pytest.mark.parametrize("address", ["127.0.0.1", "192.168.1.9"])
def test_disconnected_page_releases_the_hold(rig: Rig, address: str) -> None:
    page: Any = Page(False, True, True, address=address)
    rig.server._loop.run_until_complete(rig.server._serve_page(page))
    assert [state.pressed for state in rig.states] == [True, False]
    assert set(rig.asked) == {address == "127.0.0.1"}


def test_server_ends_with_a_release(rig: Rig) -> None:
    rig.server._end()
    rig.server.start()
    rig.server.close()
    assert rig.states == [RELEASED]
    assert not rig.server.is_alive


def test_foreign_pages_are_refused_and_counted(rig: Rig) -> None:
    connection: Any = SimpleNamespace(respond=lambda status, text: (int(status), text))

    def judged(path: str, *headers: tuple[str, str]) -> Any:
        return rig.server._check_request(connection, Request(path, Headers(headers)))

    assert judged("/hold", HOST, ORIGIN) is None
    evil = ("Origin", "http://evil.example")
    for path, headers, kind in (
        ("/hold", (("Host", "evil.example"), ORIGIN), "foreign Host"),
        ("/hold", (HOST, HOST, ORIGIN), "foreign Host"),
        ("/hold", (HOST, evil), "foreign Origin"),
        ("/hold", (HOST, ORIGIN, evil), "foreign Origin"),
        ("/hold", (HOST,), "foreign Origin"),
        ("/hold?a=b", (HOST, ORIGIN), "unknown path"),
    ):
        assert judged(path, *headers) == (403, f"{kind}\n")
    counts = {"foreign Host": 2, "foreign Origin": 3, "unknown path": 1}
    assert rig.server.counts() == counts
    assert rig.notices == [f"hold: {kind}" for kind in counts]


def test_a_port_in_use_is_reported(rig: Rig) -> None:
    with pytest.raises(UserError, match=rf"cannot listen on 127.0.0.1:{rig.server.port}: "):
        HoldServer(Access("127.0.0.1", 8080), rig.server.port, lambda _: "", print, print)
