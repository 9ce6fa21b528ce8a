"""Base of the line-based drives: input, faults of the line, time, clients, and the server."""

from __future__ import annotations

import socket
from queue import Queue

import pytest

from needle_core.component import Diagnose, Moment, Send
from needle_core.errors import UserError
from needle_sim.bus.stream_server import ClientBytes, StreamServer
from needle_sim.drive_emulator import DriveEmulator, DriveEmulatorParameters
from needle_sim.drives.motor import MotorSettings
from needle_sim.drives.text_drives import TextDrive, TextDrives


class Drives(TextDrives[TextDrive]):
    """Repeats each line; `go` moves the insertion 100 counts in 0.1 s."""

    port = "test"
    terminators = b"\n;"

    def __init__(self) -> None:
        motors = {"insertion": MotorSettings(1e3, 1e9), "rotation": MotorSettings(1e3, 1e9)}
        super().__init__(motors, -1.0, TextDrive)
        self.watched: list[float] = []

    def handle_line(self, line: str, now: float) -> bytes:
        if line == "go":
            self.drives["insertion"].powered = True
            self.drives["insertion"].demand.begin_segment(100.0, 0.1)
        return f"<{line}>".encode()

    def watch(self, now: float) -> None:
        self.watched.append(now)


def test_lines_arrive_in_pieces_and_answers_go_to_their_clients() -> None:
    drives = Drives()
    assert drives.receive((b"a", ClientBytes(b"b", 1)), 0.0) == []
    answers = drives.receive((b"1;c\r\n", ClientBytes(b"2\nd", 1)), 0.0)
    assert [(answer, getattr(answer, "client", None)) for answer in answers] == [
        *((b"<a1>", 0), (b"<c>", 0), (b"<b2>", 1))
    ]


@pytest.mark.parametrize(
    ("fault", "answers"),
    [
        ({"lost": True}, {0.0: [b"<b>"]}),
        ({"wrong": True}, {0.0: [b"<`>", b"<b>"]}),
        ({"late": 0.1}, {0.0: [], 0.09: [], 0.1: [b"<a>", b"<b>"]}),
        ({"partial": True}, {0.0: [b"<", b"a"], 0.001: [b">", b"<", b"b", b">"]}),
        ({"is_cut": True}, {0.0: [], 1.0: []}),
    ],
)
def test_a_fault_of_the_line(fault: dict[str, float], answers: dict[float, list[bytes]]) -> None:
    drives = Drives()
    for name, value in fault.items():
        setattr(drives, name, value)
    assert drives.receive((b"a;b;",), 0.0) == answers.pop(0.0)
    for now, expected in answers.items():
        assert drives.poll(now) == expected


# ---- drive_emulator ---------------------------------------------------------------------------


def test_each_axis_has_the_drives_of_its_name() -> None:
    emulator = DriveEmulator(DriveEmulatorParameters(drives="stepdir,cia402"))
    assert [port.name for port in emulator.ports] == ["stepdir", "can", "command lines"]
    moment = Moment(1.0, 1_000_000_000)
    sent = list(emulator.ports[0].handler((b"$0,I*55\n",), moment))
    assert sent == [Send("stepdir", (b"$0,I,Emulated stepdir,1,100000*21\n",))]
    actions = list(emulator.ports[2].handler(("emcy insertion 3", "reboot rotation"), moment))
    states = [action.diagnostic.values for action in actions if isinstance(action, Diagnose)]
    assert states == [
        {"insertion": "FAULT 0x0003", "rotation": "NOT_READY"},
        {"insertion": "FAULT 0x0003", "rotation": "NOT_READY"},
    ]
    (both,) = DriveEmulator(DriveEmulatorParameters(drives="stepdir")).connections.values()
    assert list(both.motors) == ["insertion", "rotation"]


# ---- the TCP server ---------------------------------------------------------------------------


def test_a_server_serves_several_clients_and_is_unplugged() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    server = StreamServer(port)
    arrived: Queue[tuple[ClientBytes, ...]] = Queue()
    server.open(arrived.put)
    try:
        with pytest.raises(UserError, match="cannot listen"):
            StreamServer(port)
        first, second = (socket.create_connection(("127.0.0.1", port)) for _ in range(2))
        with first, second:
            for number, client in enumerate((second, first)):
                client.sendall(b"%d" % number)
                (chunk,) = arrived.get(timeout=10.0)
                server.send((ClientBytes(b"re" + chunk, chunk.client),))
            server.send((b"all",))
            for number, client in enumerate((second, first)):
                assert client.recv(6, socket.MSG_WAITALL) == b"re%dall" % number
            server.plug(plugged_in=False)
            assert first.recv(1) == b""
            with pytest.raises(OSError, match="refused"):
                socket.create_connection(("127.0.0.1", port))
            server.plug(plugged_in=True)
            with socket.create_connection(("127.0.0.1", port)) as third:
                third.sendall(b"3")
                assert arrived.get(timeout=10.0) == (b"3",)
    finally:
        server.close()
