"""Access control: connections, the page, and the hold of a real rig."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from needle_console.access import Access, Gate
from needle_console.console_parameters import ConsoleParameters
from needle_console.page.page_port import PagePort
from needle_console.view.snapshot import Snapshot
from needle_core.errors import UserError
from needle_core.status_messages import DeviceStatus

LOOPBACK = Access("127.0.0.1", 8080)
HOST, ORIGIN = ("host", "127.0.0.1:8080"), ("origin", "http://127.0.0.1:8080")


def test_loopback_accepts_only_its_own_names() -> None:
    for host in ("localhost", "127.0.0.1", "127.0.0.1:8081", "LOCALHOST:8081", "[::1]:8081"):
        assert LOOPBACK.host_refusal(host) == ""
    for foreign in (
        *(None, "", "evil.example", "localhost.evil.example", "localhost.", "192.168.1.5"),
        *("127.0.0.1.evil.example", "user@localhost", "localhost:port", "[::1"),
    ):
        assert LOOPBACK.host_refusal(foreign) == "foreign Host"


def test_only_origins_with_the_page_port_are_accepted() -> None:
    for origin in ("http://localhost:8080", "http://127.0.0.1:8080", "https://[::1]:8080"):
        assert LOOPBACK.origin_refusal(origin) == ""
    for foreign in (
        *(None, "", "null", "http://localhost", "http://localhost:8081", "localhost:8080"),
        *("http://evil.example:8080", "http://localhost:8080/path", "http://localhost:8080?query"),
        *("http://user@localhost:8080", "file://localhost:8080", "http://localhost:99999"),
    ):
        assert LOOPBACK.origin_refusal(foreign) == "foreign Origin"
    # A default port is left out.
    access = Access("192.168.1.5", 80, ["rig.lab"])
    assert access.origin_refusal("http://rig.lab") == ""
    assert access.origin_refusal("https://rig.lab") == "foreign Origin"


def test_other_machines_need_a_host_name() -> None:
    with pytest.raises(UserError, match="hosts must name"):
        Access("0.0.0.0", 8080)
    with pytest.raises(UserError, match="neither an IP address"):
        Access("rig.lab", 8080)
    # The address counts as a host name; loopback names would be another machine.
    access = ConsoleParameters(address="192.168.1.5").access()
    assert access.host_refusal("192.168.1.5:8081") == ""
    assert access.host_refusal("localhost:8081") == "foreign Host"


def asked(*headers: tuple[str, str], kind: str = "http", method: str = "GET") -> dict[str, Any]:
    """Return the first answer of the gate, or of the page behind it."""
    sent: list[dict[str, Any]] = []

    async def page(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": [(b"a", b"b")]})

    async def send(message: Any) -> None:
        sent.append(dict(message))

    pairs = [(name.encode(), value.encode()) for name, value in headers]
    scope = {"type": kind, "method": method, "path": "/", "headers": pairs}
    nothing: Any = None
    asyncio.run(Gate(page, LOOPBACK)(scope, nothing, send))
    return sent[0]


def test_gate_refuses_foreign_pages_and_missing_origins() -> None:
    for headers in (
        (),
        (("host", "evil.example:8080"),),
        (HOST, ("origin", "http://evil.example")),
        (HOST, ("origin", "null")),
    ):
        refusal = asked(*headers)
        assert refusal["status"] == 403
        assert (b"x-frame-options", b"DENY") in refusal["headers"]
    assert asked(HOST, kind="websocket")["type"] == "websocket.close"
    assert asked(HOST, method="POST")["status"] == 403
    page = asked(HOST)
    assert page["status"] == 200
    assert (b"x-frame-options", b"DENY") in page["headers"]
    assert asked(HOST, ORIGIN, kind="websocket")["status"] == 200
    assert asked(HOST, ORIGIN, method="POST")["status"] == 200
    assert asked(kind="lifespan")["status"] == 200


@pytest.mark.parametrize("is_local", [True, False])
@pytest.mark.parametrize("hold_real_rig", [True, False])
def test_real_rig_is_held_only_locally_and_if_allowed(hold_real_rig: bool, is_local: bool) -> None:
    port = PagePort(ConsoleParameters(hold_real_rig=hold_real_rig))
    # An unknown device may be a real one.
    assert (port.hold_refusal(is_local) == "") == (hold_real_rig and is_local)
    for simulated in (True, False, None):
        port.send((Snapshot(device=DeviceStatus(simulated=simulated)),))
        may_hold = not port.hold_refusal(is_local)
        assert may_hold == (simulated is True or (hold_real_rig and is_local))


def test_page_and_hold_need_two_ports() -> None:
    with pytest.raises(UserError, match="8081, expected two"):
        ConsoleParameters(port=8081)
