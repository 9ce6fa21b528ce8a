"""Lines of the step/direction board's backend, against bytes from the sketch's description."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from needle_device_driver.axes.link import DriveError
from needle_device_driver.backends.stepdir import StepdirProtocol
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.polled.drive_protocol import DriveReply
from needle_device_driver.polled.text_link import TextLink
from needle_device_driver.procedure import Procedure, Running, T, run, side_by_side

STEPS = {"insertion_counts_per_unit": 1.6e6, "rotation_counts_per_unit": 1000.0}
BEATS = (b",B*",)


class Board:
    """A protocol, and the other end of its line: answers by letter; None: silent."""

    def __init__(self, *axes: str, **parameters: float | bool) -> None:
        settings = DeviceDriverParameters(**{**STEPS, **parameters})
        self.link = TextLink("board", b"\n")
        self.link.open()
        names = axes or ("insertion", "rotation")
        self.protocol = StepdirProtocol(
            settings, {name: settings.axis(name) for name in names}, self.link
        )
        self.statuses: list[tuple[int, dict[str, DriveReply]]] = []
        self.protocol.on_status = lambda number, at: self.statuses.append((number, dict(at)))
        self.answers: dict[bytes, bytes | None] = {b"I": b",stepdir,1,10000", b"C": b"", b"R": b""}
        self.lines: list[bytes] = []

    def exchange(self) -> None:
        for data in self.link.pop_outgoing():
            for line in data.splitlines(keepends=True):
                self.lines.append(line)
                number, _, rest = line[1:-4].partition(b",")
                answer = self.answers.get(rest[:1])
                if answer is not None:
                    self.receive(number + b"," + rest[:1] + answer)

    def receive(self, body: bytes) -> None:
        checksum = 0
        for byte in body:
            checksum ^= byte
        self.feed(b"$%s*%02X\n" % (body, checksum))

    def feed(self, *chunks: bytes) -> None:
        for line in self.link.receive(chunks):
            self.protocol.on_line(line)

    def run(self, procedure: Procedure[T]) -> T:
        def wait(is_there: Callable[[], bool], seconds: float) -> None:
            self.exchange()
            self.link.now += 0.0 if is_there() else seconds

        return run(procedure, wait, lambda: self.link.now)


def test_the_set_up_switches_off_and_tells_ramp_switch_and_dead_man() -> None:
    board = Board(watchdog=0.15, rotation_reverse=True)
    assert board.run(board.protocol.identify()) == "stepdir 1"
    board.run(board.protocol.set_up("insertion"))
    board.run(board.protocol.set_up("rotation"))
    sent = [line[1:-4] for line in board.lines if not any(beat in line for beat in BEATS)]
    assert [body.partition(b",")[2] for body in sent[1:]] == [
        *(b"I", b"P,0,0", b"R", b"C,0,800000,-1,150"),
        *(b"P,1,0", b"R", b"C,1,100000,1,150"),
    ]


def test_orders_and_a_request_have_these_bytes() -> None:
    board = Board()
    protocol = board.protocol
    protocol.power("insertion", True)
    protocol.move_to("rotation", -250, 4000)
    protocol.stop("insertion")
    protocol.beat()
    protocol.request(7)
    (sent,) = board.link.pop_outgoing()
    assert sent == b"$0,P,0,1*4D\n$1,M,1,-250,20*55\n$2,H,0*4A\n$3,B*5D\n$4,S*4B\n"
    # In pieces, after noise, and after a line without its checksum.
    board.feed(b"\xff\n$4,S,0,9,9,9,9*00\n$4,S,0,800,2", b"1,-250,27", b"*73\n")
    assert board.statuses == [
        (
            7,
            {
                "insertion": DriveReply(800, moving=False, powered=True, home_switch=True),
                "rotation": DriveReply(-250, moving=True, powered=True, inner_switch=True),
            },
        )
    ]
    # The same answer again, and one to an unknown line.
    board.receive(b"4,S,0,0,16,0,16")
    board.receive(b"9,S,0,0,16,0,16")
    assert len(board.statuses) == 1


@pytest.mark.parametrize(
    ("state", "found"),
    [
        (b"1,5,17,0,17", DriveReply(5, moving=False, powered=True, timed_out=True)),
        (b"0,5,0,0,17", DriveReply(5, moving=False, powered=False, rebooted=True)),
        (b"2,5,17,0,17", DriveReply(5, moving=False, powered=True, conflict=True)),
        (b"9,5,16,0,0", DriveReply(5, moving=False, powered=False, fault="reports fault 9")),
    ],
)
def test_faults_of_the_board(state: bytes, found: DriveReply) -> None:
    board = Board("insertion")
    board.protocol.request(1)
    board.receive(b"0,S," + state)
    assert board.statuses == [(1, {"insertion": found})]


def test_a_board_that_is_too_slow_silent_or_of_another_version_is_an_error() -> None:
    board = Board(max_speed=0.005, insertion_counts_per_unit=2e7)
    board.run(board.protocol.identify())
    with pytest.raises(DriveError, match="5 mm/s are 100000 steps/s, limit 10000 of the board"):
        board.run(board.protocol.set_up("insertion"))
    board.answers[b"I"] = b",stepdir,2,10000,9"
    with pytest.raises(DriveError, match="version 1: load the sketch"):
        board.run(board.protocol.identify())
    del board.answers[b"I"]
    with pytest.raises(DriveError, match="no answer"):
        board.run(board.protocol.identify())


def test_lines_are_numbered_in_the_order_of_sending() -> None:
    board = Board()
    board.run(board.protocol.identify())
    both = side_by_side(board.protocol.set_up("insertion"), board.protocol.set_up("rotation"))
    running = Running(both)
    while not running.advance(board.link.now):
        board.link.now += 0.005
        if round(board.link.now * 1e3) % 30 == 0:
            board.exchange()
    for _ in range(300):
        board.protocol.beat()
    board.exchange()
    numbers = [int(line[1:-4].split(b",")[0]) for line in board.lines if line.startswith(b"$")]
    assert len(numbers) > 306
    assert numbers == [number % 256 for number in range(len(numbers))]
