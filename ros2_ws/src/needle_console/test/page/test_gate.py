"""The gate of the page: who is let in, and how the token is asked for."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from needle_console.access.access import Access
from needle_console.page.gate import COOKIE, Gate

TOKEN = "correct-horse-battery"
HOST = ("host", "127.0.0.1:8080")
ORIGIN = ("origin", "http://127.0.0.1:8080")


async def _behind(scope: Any, receive: Any, send: Any) -> None:
    await send({"type": "behind"})


def asked(
    gate: Gate,
    *headers: tuple[str, str],
    kind: str = "http",
    method: str = "GET",
    path: str = "/",
    body: bytes = b"",
) -> list[dict[str, Any]]:
    """Return what the gate, or the page behind it, answers."""
    said: list[dict[str, Any]] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": body}

    async def send(message: Any) -> None:
        said.append(dict(message))

    pairs = [(name.encode(), value.encode()) for name, value in headers]
    scope = {"type": kind, "method": method, "path": path, "headers": pairs}
    asyncio.run(gate(scope, receive, send))
    return said


def is_behind(said: list[dict[str, Any]]) -> bool:
    return said == [{"type": "behind"}]


@pytest.fixture
def open_gate() -> Gate:
    return Gate(_behind, Access("127.0.0.1", 8080))


@pytest.fixture
def closed_gate() -> Gate:
    return Gate(_behind, Access("0.0.0.0", 8080, TOKEN, ["127.0.0.1"]))


def test_no_page_is_shown_inside_another_one(closed_gate: Gate) -> None:
    async def page(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": [(b"a", b"b")]})

    for gate in (Gate(page, Access("127.0.0.1", 8080)), closed_gate):
        start = asked(gate, HOST)[0]
        assert (b"x-frame-options", b"DENY") in start["headers"]


@pytest.mark.parametrize(
    "headers",
    [
        (),
        (("host", "evil.example:8080"),),
        (HOST, ("origin", "http://evil.example")),
        (HOST, ("origin", "http://127.0.0.1:9999")),
        (HOST, ("origin", "null")),
    ],
)
def test_foreign_hosts_and_origins_are_refused(
    open_gate: Gate, headers: tuple[tuple[str, str], ...]
) -> None:
    assert asked(open_gate, *headers)[0]["status"] == 403


def test_an_upgrade_or_a_post_needs_an_origin(open_gate: Gate) -> None:
    assert is_behind(asked(open_gate, HOST))
    assert asked(open_gate, HOST, kind="websocket")[0]["type"] == "websocket.close"
    assert asked(open_gate, HOST, method="POST")[0]["status"] == 403
    assert is_behind(asked(open_gate, HOST, ORIGIN, kind="websocket"))
    assert is_behind(asked(open_gate, HOST, ORIGIN, method="POST"))


def test_without_the_token_there_is_only_the_question_for_it(closed_gate: Gate) -> None:
    page = asked(closed_gate, HOST)
    assert page[0]["status"] == 200
    assert b"password" in page[1]["body"]
    assert asked(closed_gate, HOST, path="/view/left.jpg")[0]["status"] == 403
    assert asked(closed_gate, HOST, ORIGIN, kind="websocket")[0]["type"] == "websocket.close"


def test_a_wrong_token_opens_nothing(closed_gate: Gate) -> None:
    for body in (b"token=wrong", b"", b"token=" + b"x" * 100_000, b"\xff\xfe"):
        said = asked(closed_gate, HOST, ORIGIN, method="POST", path="/login", body=body)
        assert said[0]["status"] == 403
        assert b"set-cookie" not in dict(said[0]["headers"])
    for cookie in (f"{COOKIE}=", f"{COOKIE}={TOKEN}", "\x7f;;==", f"{COOKIE}=\N{SNOWMAN}"):
        assert not is_behind(asked(closed_gate, HOST, ("cookie", cookie)))


def test_the_right_token_gives_a_cookie_that_opens(closed_gate: Gate) -> None:
    body = f"token={TOKEN}".encode()
    said = asked(closed_gate, HOST, ORIGIN, method="POST", path="/login", body=body)
    assert said[0]["status"] == 303
    cookie = dict(said[0]["headers"])[b"set-cookie"].decode()
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    assert TOKEN not in cookie
    mine = ("cookie", cookie.partition(";")[0])
    assert is_behind(asked(closed_gate, HOST, mine))
    assert is_behind(asked(closed_gate, HOST, ORIGIN, mine, kind="websocket"))
    # Of another start of the console it is none.
    other = Gate(_behind, Access("0.0.0.0", 8080, TOKEN, ["127.0.0.1"]))
    assert not is_behind(asked(other, HOST, mine))


def test_a_foreign_page_cannot_log_in_for_somebody(closed_gate: Gate) -> None:
    body = f"token={TOKEN}".encode()
    evil = ("origin", "http://evil.example")
    said = asked(closed_gate, HOST, evil, method="POST", path="/login", body=body)
    assert said[0]["status"] == 403
