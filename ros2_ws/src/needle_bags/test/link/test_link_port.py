"""Port that sends the same data to all clients, regardless of their input and reading speed."""

from __future__ import annotations

import contextlib
import random
import socket
import struct
from collections.abc import Iterator

import pytest

from needle_bags.link.link_port import LinkPort
from needle_core.errors import UserError
from needle_core.openigtlink import LinkMessage

# A message with a length of 2^64 bytes and no body; another protocol; noise.
HEADER = struct.pack("> H 12s 20s II Q Q", 1, b"TRANSFORM", b"\xfe" * 20, 0, 0, 2**64 - 1, 0)
GARBAGE = (HEADER, b"GET / HTTP/1.1\r\n\r\n", random.Random(1).randbytes(100_000))


@pytest.fixture
def server() -> Iterator[LinkPort]:
    with contextlib.closing(LinkPort("127.0.0.1", 0)) as one:
        yield one


def listener(server: LinkPort) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", server.port), timeout=5.0)
    before = server.listeners
    while server.listeners == before:
        server.exchange(b"")
    return connection


def read(connection: socket.socket, count: int) -> bytes:
    return connection.recv(count, socket.MSG_WAITALL)


def test_all_clients_receive_the_same_regardless_of_other_input(server: LinkPort) -> None:
    with pytest.raises(UserError, match=rf"127\.0\.0\.1, port {server.port}: Address already"):
        LinkPort("127.0.0.1", server.port)
    with listener(server) as good:
        for garbage in GARBAGE:
            with listener(server) as bad:
                bad.sendall(garbage)
                server.exchange(b"")
                server.exchange(b"needle")
                assert read(good, 6) == read(bad, 6) == b"needle"
                # Half a message, then a connection reset.
                bad.sendall(garbage[:7])
                bad.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            while server.listeners.count == 2:
                server.exchange(b"")
        good.shutdown(socket.SHUT_WR)
        while server.listeners.count:
            server.exchange(b"")
        assert good.recv(1) == b""


def test_messages_arrive_and_garbage_of_one_client_ends_its_input_only(server: LinkPort) -> None:
    text = struct.pack("> H 12s 20s II Q Q", 1, b"POINT", b"target", 0, 0, 3, 0) + b"abc"
    with listener(server) as good, listener(server) as bad:
        found: list[LinkMessage] = []
        for client, data in ((bad, b"GET / HTTP/1.1\r\n" + bytes(58)), (good, text), (bad, text)):
            client.sendall(data)
        # The kernel may deliver out of order across sockets.
        while not (found and server.listeners.problems):
            found += server.exchange(b"")
        assert found == [LinkMessage(1, "POINT", "target", 0.0, b"abc")]
        assert len(server.listeners.problems) == 1
        assert server.listeners.count == 2


def test_a_client_that_does_not_read_delays_no_other_and_is_disconnected(server: LinkPort) -> None:
    data = bytes(10_000)
    with listener(server) as asleep, listener(server) as awake:
        while server.listeners.count == 2:
            server.exchange(data)
            assert read(awake, len(data)) == data
        asleep.settimeout(5.0)
        with contextlib.suppress(ConnectionError):
            while asleep.recv(1_000_000):
                pass
