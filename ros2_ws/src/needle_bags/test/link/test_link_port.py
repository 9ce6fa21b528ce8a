"""The port that says the same to all: whatever they send, and however slowly they read."""

from __future__ import annotations

import contextlib
import random
import socket
import struct
from collections.abc import Iterator

import pytest

from needle_bags.link.link_port import MAX_CLIENTS, STALL_TIMEOUT, LinkServer
from needle_bags.link.openigtlink import Listeners
from needle_core.errors import UserError
from needle_core.openigtlink import LinkMessage

# A message of 2^64 bytes, of which none comes; another protocol; noise.
HEADER = struct.pack("> H 12s 20s II Q Q", 1, b"TRANSFORM", b"\xfe" * 20, 0, 0, 2**64 - 1, 0)
GARBAGE = (HEADER, b"GET / HTTP/1.1\r\n\r\n", random.Random(1).randbytes(100_000))


@pytest.fixture
def server() -> Iterator[LinkServer]:
    with contextlib.closing(LinkServer("127.0.0.1", 0)) as one:
        yield one


def listener(server: LinkServer) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", server.port), timeout=5.0)
    before = server.listeners
    while server.listeners == before:
        server.poll(0.0)
    return connection


def read(connection: socket.socket, count: int) -> bytes:
    return b"".join(connection.recv(1) for _ in range(count))


def test_all_clients_receive_the_same_whatever_another_sends(server: LinkServer) -> None:
    with pytest.raises(UserError, match=rf"127\.0\.0\.1, port {server.port}: Address already"):
        LinkServer("127.0.0.1", server.port)
    with listener(server) as good:
        for garbage in GARBAGE:
            with listener(server) as bad:
                bad.sendall(garbage)
                server.poll(0.0)
                server.send(b"needle", 0.0)
                assert read(good, 6) == read(bad, 6) == b"needle"
                # Half a message, then gone: with a reset.
                bad.sendall(garbage[:7])
                bad.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            while server.listeners.count == 2:
                server.poll(0.0)
        good.shutdown(socket.SHUT_WR)
        while server.listeners.count:
            server.poll(0.0)
        assert good.recv(1) == b""


def test_messages_arrive_and_garbage_of_one_client_ends_its_input_only(server: LinkServer) -> None:
    text = struct.pack("> H 12s 20s II Q Q", 1, b"POINT", b"target", 0, 0, 3, 0) + b"abc"
    with listener(server) as good, listener(server) as bad:
        found: list[LinkMessage] = []
        for client, data in ((bad, b"GET / HTTP/1.1\r\n" + bytes(58)), (good, text), (bad, text)):
            client.sendall(data)
        # The order in which the kernel delivers is not that of the sockets.
        while not (found and server.listeners.problems):
            found += server.poll(0.0)
        assert found == [LinkMessage(1, "POINT", "target", 0.0, b"abc")]
        assert len(server.listeners.problems) == 1
        assert server.listeners.count == 2


def test_clients_beyond_the_limit_are_turned_away(server: LinkServer) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(MAX_CLIENTS + 1):
            last = stack.enter_context(listener(server))
        assert last.recv(1) == b""
        assert server.listeners == Listeners(MAX_CLIENTS, 1)


def test_a_client_that_does_not_read_delays_no_other_and_is_disconnected(
    server: LinkServer,
) -> None:
    data = bytes(20_000_000)
    with listener(server) as asleep:
        server.send(data, 1.0)
        with listener(server) as awake:
            # What it has not read yet is not added to: its next message begins where one ends.
            server.send(b"needle", 2.0)
            assert read(awake, 6) == b"needle"
            server.poll(1.0 + STALL_TIMEOUT)
            assert server.listeners.count == 2
            server.poll(1.1 + STALL_TIMEOUT)
            assert server.listeners.count == 1
        received = b""
        with contextlib.suppress(ConnectionError):
            while part := asleep.recv(1_000_000):
                received += part
        assert len(received) < len(data)
        assert b"needle" not in received
