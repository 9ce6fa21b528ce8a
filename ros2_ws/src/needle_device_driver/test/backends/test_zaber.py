"""ASCII protocol of the Zaber backend against a scripted exchange of bytes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import pytest

from needle_core.errors import UserError
from needle_device_driver.axes.link import DriveError
from needle_device_driver.backends.zaber import ZaberProtocol
from needle_device_driver.polled.drive_protocol import DriveReply

from .protocol_bench import ProtocolBench

MESSAGE = re.compile(r"/(\d+) (\d) (\d+) ([^:]*):..\n")
"""Device, axis, number and text of a message."""
NEW = {
    "get version": "7.38",
    "get system.serial": "0",
    "get device.id": "50952",
    "warnings": "01 WR",
    "get limit.home.state": "1",
    "get limit.away.state": "0",
    "get encoder.pos": "900",
    "get pos": "1000",
}
"""Data of a device that has everything, after power-up."""


class Line(ProtocolBench[ZaberProtocol]):
    """Devices that answer commands from a table, else with 0; None: rejected."""

    def __init__(self, changes: Mapping[str, str | None] | None = None, **parameters: Any) -> None:
        counts = {"insertion_counts_per_unit": 1e6, "rotation_counts_per_unit": 1000.0}
        super().__init__(ZaberProtocol, **counts | parameters)
        self.data: Mapping[str, str | None] = {**NEW, **(changes or {})}
        self.is_silent = False
        self.commands: list[str] = []

    def receive_lines(self, *texts: str) -> None:
        """Receive replies without their checksum and line end."""
        for text in texts:
            self.receive(f"{text}:{-sum(text[1:].encode()) % 256:02X}\r\n".encode())

    def reply(self, sent: bytes) -> None:
        for device, axis, number, command in MESSAGE.findall(sent.decode()):
            self.commands.append(f"{device} {axis} {command}")
            answer = self.data.get(command, "0")
            flag = "OK" if answer is not None else "RJ"
            if not self.is_silent:
                text = f"{flag} IDLE WR {answer or 'BADCOMMAND'}"
                self.receive_lines(f"@{device:>02} {axis} {number:>02} {text}")

    def ready(self) -> Line:
        self.run(self.protocol.identify())
        self.set_up()
        self.commands.clear()
        return self

    def answered(self, number: int, *, flag: str = "--", status: str = "IDLE") -> DriveReply:
        """Request, answer positions 900 and else 0; return the state of the rotation axis."""
        self.protocol.request(number)
        for device in (1, 2):
            for message_id, data in ((1 + number, "900"), (34 + number, "0")):
                self.receive_lines(f"@{device:02} 1 {message_id:02} OK {status} {flag} {data}")
        assert self.states[-1][0] == number
        return self.state("rotation")


def test_identify_ends_a_partial_line_and_switches_checksums_on() -> None:
    line = Line()
    procedure = line.protocol.identify()
    next(procedure)
    assert line.sent() == b"\n/1 0 67 get version:6C\n"
    procedure.close()
    assert line.run(line.protocol.identify()) == (
        "Emulated Zaber, device 1: ID 50952, firmware 7.38, device 2: ID 50952, firmware 7.38"
    )
    assert {"1 0 set comm.checksum 1", "2 0 set comm.checksum 1"} <= {*line.commands}


@pytest.mark.parametrize("version", ["7.24", "unknown"])
def test_firmware_without_the_speed_of_a_move_is_refused(version: str) -> None:
    line = Line({"get version": version})
    with pytest.raises(DriveError, match=rf"device 1 has firmware {version}, and 7\.25"):
        line.run(line.protocol.identify())


def test_set_up_of_a_device_after_power_up() -> None:
    line = Line()
    line.run(line.protocol.set_up("insertion"))
    # 0.5 m/s^2 and 5 mm/s at 1e6 counts/m: values 500000 * 1.6384e-4 and 5000 * 1.6384.
    assert [text.removeprefix("1 1 ") for text in line.commands] == [
        *("driver disable", "set accel 82", "set maxspeed 8192", "set limit.min -1000000000"),
        *("set limit.max 1000000000", "set knob.enable 0", "warnings clear", "warnings"),
        *("set pos 0", "get limit.home.state", "get limit.away.state", "get encoder.pos"),
        "get pos",
    ]
    # A position that has a reference is kept.
    line = Line({"warnings": "01 WH"})
    line.run(line.protocol.set_up("insertion"))
    assert "1 1 set pos 0" not in line.commands


def test_orders_are_point_moves_with_their_own_speed() -> None:
    line = Line().ready()
    line.protocol.move_to("insertion", 1200, 10_000)
    line.protocol.move_to("rotation", -5, 1)
    assert line.sent() == b"/1 1 0 move abs 1200 16384:F8\n/2 1 0 move abs -5 2:2C\n"


def test_the_last_set_points_make_up_for_the_ramps() -> None:
    line = Line().ready()
    for position, speed in ((100, 1000), (110, 500), (110, 1)):
        line.protocol.move_to("insertion", position, speed)
    line.protocol.stop("insertion")
    line.protocol.move_to("insertion", 110, 1)
    speeds = [int(speed) for speed in re.findall(r"move abs \d+ (\d+)", line.sent().decode())]
    # 1000, 800, 640 and, after the stop, 1 count/s.
    assert speeds == [1639, 1311, 1049, 2]


def test_each_request_asks_for_positions_and_one_slow_state() -> None:
    line = Line().ready()
    home, away, warnings = "get limit.home.state", "get limit.away.state", "warnings"
    for number, slow, is_of_both in ((4, home, 0), (5, away, 0), (6, home, 0), (7, warnings, 1)):
        line.protocol.request(number)
        position, state = (str(1 + number), "get encoder.pos"), (str(34 + number), slow)
        insertion = [("1", "1", *position), ("1", "1", *state)]
        rotation = [("2", "1", *position), ("2", "1", *state)][: 1 + is_of_both]
        assert MESSAGE.findall(line.sent().decode()) == insertion + rotation


@pytest.mark.parametrize(("method", "asks"), [(17, True), (37, False)])
def test_a_rotation_homed_at_its_position_has_no_switches(method: int, asks: bool) -> None:
    line = Line(rotation_homing_method=method)
    line.run(line.protocol.set_up("rotation"))
    assert ("2 1 get limit.home.state" in line.commands) is asks


@pytest.mark.parametrize("missing", [None, "NA"])
def test_a_device_without_encoder_and_sensors_counts_its_steps(missing: str | None) -> None:
    names = ("get limit.home.state", "get limit.away.state", "get encoder.pos", "set knob.enable 0")
    line = Line(dict.fromkeys(names, missing)).ready()
    line.answered(4)
    assert [command for *_, command in MESSAGE.findall(line.sent().decode())] == ["get pos"] * 2
    assert line.state() == DriveReply(900, moving=False, powered=True)


@pytest.mark.parametrize(
    ("flag", "status", "powered", "fault", "rebooted"),
    [
        ("--", "BUSY", True, "", False),
        ("WR", "IDLE", True, "", True),
        ("FO", "IDLE", False, "", False),
        ("FS", "IDLE", True, "stalled and stopped (FS)", False),
        ("FX", "IDLE", True, "reports a fault (FX)", False),
        ("NC", "BUSY", True, "is moved by its knob (NC)", False),
        ("NC", "IDLE", True, "", False),
    ],
)
def test_warning_flags(flag: str, status: str, powered: bool, fault: str, rebooted: bool) -> None:
    at = Line().ready().answered(5, flag=flag, status=status)
    # After set-up the count was 1000 where the encoder had 900.
    assert at == DriveReply(1000, status == "BUSY", powered, fault=fault, rebooted=rebooted)


def test_a_restart_shows_behind_a_higher_flag() -> None:
    line = Line().ready()
    line.protocol.request(7)
    line.receive_lines("@01 1 08 OK IDLE WV 900", "@01 1 41 OK IDLE WV 02 WV WR")
    line.receive_lines("@02 1 08 OK IDLE WV 900", "@02 1 41 OK IDLE WV 01 WV")
    assert (line.state().rebooted, line.state("rotation").rebooted) == (True, False)
    line.run(line.protocol.clear_fault("insertion"))
    assert line.commands[-1] == "1 1 warnings clear"


COMPLETE = (
    "@01 1 08 OK IDLE -- 900",
    "@01 1 41 OK IDLE -- 0",
    "@02 1 08 OK IDLE -- 900",
    "@02 1 41 OK IDLE -- 0",
)


@pytest.mark.parametrize(
    "instead",
    [
        b"",
        b"@01 1 08 OK IDLE -- 900:00\r\n",
        b"@01 1 08 OK IDLE -- 900\r\n",
        b"@01 1 08 RJ IDLE -- BADCOMMAND:6C\r\n@01 1 41 RJ IDLE -- BADCOMMAND:6F\r\n",
        b"!01 1 IDLE -- 0:46\r\n#01 1 08 900:0D\r\n@03 1 08 OK IDLE -- 900:99\r\n",
        b"@01 1 08 OK IDLE -- NA:A5\r\n@01 1 00 OK IDLE -- 900:A3\r\n\xff\n@01\r\n\r\n",
    ],
)
def test_an_incomplete_or_wrong_answer_is_none(instead: bytes) -> None:
    line = Line().ready()
    line.protocol.request(7)
    first, *others = COMPLETE
    line.receive_lines(*others)
    line.receive(instead)
    assert line.states == []
    line.receive_lines(first)
    assert len(line.states) == 1


def test_a_rejected_setting_and_silence_are_errors() -> None:
    line = Line({"set accel 16": None})
    with pytest.raises(DriveError, match="device 2 refuses 'set accel 16': BADCOMMAND"):
        line.run(line.protocol.set_up("rotation"))
    before, line.is_silent = line.link.now, True
    with pytest.raises(DriveError, match=r"no answer to '/1 1 \d\d driver disable"):
        line.run(line.protocol.release("insertion"))
    assert 0.5 <= line.link.now - before < 0.6


@pytest.mark.parametrize("text", ["", "0", "100", "1 0", "a", "1 1"])
def test_a_wrong_device_is_refused(text: str) -> None:
    with pytest.raises(UserError, match="zaber_rotation_device"):
        Line(zaber_rotation_device=text)


def test_two_axes_of_one_device() -> None:
    line = Line(zaber_rotation_device="1 2")
    line.protocol.stop("rotation")
    assert line.sent().startswith(b"/1 2 0 stop")
