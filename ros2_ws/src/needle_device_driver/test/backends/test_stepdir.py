"""Lines of the step/direction board's backend, against bytes from the sketch's description."""

from __future__ import annotations

from typing import Any

import pytest

from needle_device_driver.axes.link import DriveError
from needle_device_driver.backends.stepdir import StepdirProtocol
from needle_device_driver.polled.drive_protocol import DriveReply

from .protocol_bench import ProtocolBench


class Board(ProtocolBench[StepdirProtocol]):
    """A board that replies by letter; without a reply it is silent."""

    def __init__(self, **parameters: Any) -> None:
        counts = {"insertion_counts_per_unit": 1.6e6, "rotation_counts_per_unit": 1000.0}
        super().__init__(StepdirProtocol, **counts | parameters)
        self.replies = {b"I": b",stepdir,1,10000", b"C": b"", b"R": b""}
        self.lines: list[bytes] = []

    def reply(self, sent: bytes) -> None:
        for line in sent.splitlines():
            self.lines.append(line)
            number, _, rest = line[1:-3].partition(b",")
            if rest[:1] in self.replies:
                self.receive_frame(number + b"," + rest[:1] + self.replies[rest[:1]])

    def receive_frame(self, body: bytes) -> None:
        checksum = 0
        for byte in body:
            checksum ^= byte
        self.receive(b"$%s*%02X\n" % (body, checksum))


def test_the_set_up_switches_off_and_sends_ramp_switch_and_dead_man() -> None:
    board = Board(watchdog=0.15, rotation_reverse=True)
    assert board.run(board.protocol.identify()) == "stepdir 1"
    board.set_up()
    sent = [line[1:-3].partition(b",")[2] for line in board.lines[1:]]
    assert [body for body in sent if body != b"B"] == [
        *(b"I", b"P,0,0", b"R", b"C,0,800000,-1,150"),
        *(b"P,1,0", b"R", b"C,1,100000,1,150"),
    ]


def test_orders_and_a_request_have_these_bytes() -> None:
    board = Board()
    board.protocol.power("insertion", True)
    board.protocol.move_to("rotation", -250, 4000)
    board.protocol.stop("insertion")
    board.protocol.beat()
    board.protocol.request(7)
    assert board.sent() == b"$0,P,0,1*4D\n$1,M,1,-250,20*55\n$2,H,0*4A\n$3,B*5D\n$4,S*4B\n"
    # After noise, after a line with a wrong checksum, and in pieces.
    board.receive(b"\xff\n$4,S,0,9,9,9,9*00\n$4,S,0,800,2", b"1,-250,27", b"*73\n")
    # A second answer to the same line, and one to an unknown line.
    board.receive_frame(b"4,S,0,0,16,0,16")
    board.receive_frame(b"9,S,0,0,16,0,16")
    insertion = DriveReply(800, moving=False, powered=True, home_switch=True)
    rotation = DriveReply(-250, moving=True, powered=True, inner_switch=True)
    assert board.states == [(7, {"insertion": insertion, "rotation": rotation})]


def test_a_stop_by_the_dead_man_shows() -> None:
    board = Board()
    board.protocol.request(1)
    board.receive_frame(b"0,S,1,5,17,0,17")
    assert board.state() == DriveReply(5, moving=False, powered=True, timed_out=True)


def test_a_board_that_is_too_slow_silent_or_of_another_version_is_an_error() -> None:
    board = Board(max_speed=0.005, insertion_counts_per_unit=2e7)
    board.run(board.protocol.identify())
    with pytest.raises(DriveError, match="5 mm/s are 100000 steps/s, limit 10000 of the board"):
        board.set_up()
    board.replies[b"I"] = b",stepdir,2,10000,9"
    with pytest.raises(DriveError, match="version 1: load the sketch"):
        board.run(board.protocol.identify())
    del board.replies[b"I"]
    with pytest.raises(DriveError, match="no answer"):
        board.run(board.protocol.identify())
