"""The gate of the page: who is let in."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from needle_console.access.access import Access
from needle_console.page.gate import Gate

HOST = ("host", "127.0.0.1:8080")
ORIGIN = ("origin", "http://127.0.0.1:8080")


async def _behind(scope: Any, receive: Any, send: Any) -> None:
    await send({"type": "behind"})


def asked(
    gate: Gate,
    *headers: tuple[str, str],
    kind: str = "http",
    method: str = "GET",
) -> list[dict[str, Any]]:
    """Return what the gate, or the page behind it, answers."""
    said: list[dict[str, Any]] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b""}

    async def send(message: Any) -> None:
        said.append(dict(message))

    pairs = [(name.encode(), value.encode()) for name, value in headers]
    scope = {"type": kind, "method": method, "path": "/", "headers": pairs}
    asyncio.run(gate(scope, receive, send))
    return said


def is_behind(said: list[dict[str, Any]]) -> bool:
    return said == [{"type": "behind"}]


@pytest.fixture
def open_gate() -> Gate:
    return Gate(_behind, Access("127.0.0.1", 8080))


def test_no_page_is_shown_inside_another_one() -> None:
    async def page(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": [(b"a", b"b")]})

    gate = Gate(page, Access("127.0.0.1", 8080))
    for start in (asked(gate, HOST)[0], asked(gate)[0]):
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
