"""Who may open a connection."""

from __future__ import annotations

import pytest

from needle_console.access.access import Access
from needle_core.errors import UserError


def test_loopback_is_known_by_its_own_names_only() -> None:
    access = Access("127.0.0.1", 8080)
    for host in ("localhost", "127.0.0.1", "127.0.0.1:8081", "LOCALHOST:8081", "[::1]:8081"):
        assert access.why_not_host(host) == ""
    for foreign in (
        None,
        "",
        "evil.example",
        "evil.example:8081",
        "localhost.evil.example",
        "localhost.",
        "127.0.0.1.evil.example",
        "user@localhost",
        "localhost:port",
        "[::1",
        "192.168.1.5",
    ):
        assert access.why_not_host(foreign) == "foreign Host"


def test_only_the_page_of_the_same_port_is_no_foreign_page() -> None:
    access = Access("127.0.0.1", 8080)
    for origin in ("http://localhost:8080", "http://127.0.0.1:8080", "https://[::1]:8080"):
        assert access.why_not_origin(origin) == ""
    for foreign in (
        None,
        "",
        "null",
        "http://localhost",
        "http://localhost:8081",
        "http://evil.example:8080",
        "http://localhost:8080/path",
        "http://localhost:8080?query",
        "http://user@localhost:8080",
        "file://localhost:8080",
        "localhost:8080",
        "http://localhost:8080.evil.example",
        "http://localhost:99999",
    ):
        assert access.why_not_origin(foreign) == "foreign Origin"


def test_a_default_port_needs_not_be_said() -> None:
    access = Access("192.168.1.5", 80, ["rig.lab"])
    assert access.why_not_origin("http://rig.lab") == ""
    assert access.why_not_origin("https://rig.lab") == "foreign Origin"


def test_beyond_this_machine_it_takes_a_name() -> None:
    with pytest.raises(UserError, match="hosts must name"):
        Access("0.0.0.0", 8080)
    with pytest.raises(UserError, match="neither an IP address"):
        Access("rig.lab", 8080)
    # What is listened on is a name of its own; loopback's names are another machine's here.
    access = Access("192.168.1.5", 8080)
    assert access.why_not_host("192.168.1.5:8081") == ""
    assert access.why_not_host("localhost:8081") == "foreign Host"
