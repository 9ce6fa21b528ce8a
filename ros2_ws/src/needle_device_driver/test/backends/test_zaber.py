"""ASCII protocol of the Zaber backend against a scripted exchange of bytes."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import pytest

from needle_core.errors import UserError
from needle_device_driver.axes.link import DriveError
from needle_device_driver.backends.zaber import ZaberProtocol
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.polled.drive_protocol import DriveReply
from needle_device_driver.polled.text_link import TextLink
from needle_device_driver.procedure import Procedure, T, run

AXES = ("insertion", "rotation")
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


class Line:
    """A protocol, and the other end of its line: a table from command to data, None: rejected."""

    def __init__(self, **parameters: Any) -> None:
        settings = DeviceDriverParameters(
            insertion_drive="zaber",
            rotation_drive="zaber",
            insertion_counts_per_unit=1e6,
            rotation_counts_per_unit=1000.0,
            **parameters,
        )
        self.link = TextLink("zaber", b"\n")
        self.link.open()
        self.protocol = ZaberProtocol(settings, {a: settings.axis(a) for a in AXES}, self.link)
        self.statuses: list[tuple[int, dict[str, DriveReply]]] = []
        self.protocol.on_status = lambda number, at: self.statuses.append((number, dict(at)))
        self.received: list[str] = []

    def sent(self) -> bytes:
        return b"".join(self.link.pop_outgoing())

    def receive(self, *texts: str) -> None:
        """Receive replies without their checksum and line end."""
        for text in texts:
            self.receive_bytes(f"{text}:{-sum(text[1:].encode()) % 256:02X}\r\n".encode())

    def receive_bytes(self, data: bytes) -> None:
        for line in self.link.receive((data,)):
            self.protocol.on_line(line)

    def talk(self, procedure: Procedure[T], data: Mapping[str, str | None] | None) -> T:
        """Run a procedure with a device that answers from a table, else with 0, or not at all."""

        def wait(is_there: Callable[[], bool], seconds: float) -> None:
            for device, axis, number, command in re.findall(
                r"/(\d+) (\d) (\d+) ([^:]*):..\n", self.sent().decode()
            ):
                self.received.append(f"{device} {axis} {command}")
                if data is None:
                    continue
                answer = data.get(command, "0")
                flag = "OK" if answer is not None else "RJ"
                self.receive(
                    f"@{device:>02} {axis} {number:>02} {flag} IDLE WR {answer or 'BADCOMMAND'}"
                )
            self.link.now += 0.0 if is_there() else seconds

        return run(procedure, wait, lambda: self.link.now)

    def ready(self, data: Mapping[str, str | None] = NEW) -> Line:
        self.talk(self.protocol.identify(), data)
        for axis in AXES:
            self.talk(self.protocol.set_up(axis), data)
        self.received.clear()
        return self

    def answer(self, number: int, *, flag: str = "--", status: str = "IDLE") -> None:
        """Answer a request of both axes: positions 900 and 900, other states 0."""
        for device in (1, 2):
            for message_id, data in ((1 + number, "900"), (34 + number, "0")):
                self.receive(f"@{device:02} 1 {message_id:02} OK {status} {flag} {data}")


def test_identify_ends_a_partial_line_and_switches_checksums_on() -> None:
    line = Line()
    procedure = line.protocol.identify()
    next(procedure)
    assert line.sent() == b"\n/1 0 67 get version:6C\n"
    procedure.close()
    assert line.talk(line.protocol.identify(), NEW) == (
        "Emulated Zaber, device 1: ID 50952, firmware 7.38, device 2: ID 50952, firmware 7.38"
    )
    assert "1 0 set comm.checksum 1" in line.received
    assert "2 0 set comm.checksum 1" in line.received
    real = {**NEW, "get system.serial": "49822"}
    assert line.talk(line.protocol.identify(), real).startswith("Zaber, device 1")


@pytest.mark.parametrize("version", ["7.24", "6.28", "unknown"])
def test_firmware_without_the_speed_of_a_move_is_refused(version: str) -> None:
    line = Line()
    with pytest.raises(DriveError, match=rf"device 1 has firmware {version}, and 7\.25"):
        line.talk(line.protocol.identify(), {**NEW, "get version": version})


def test_set_up_of_a_device_after_power_up() -> None:
    line = Line()
    line.talk(line.protocol.set_up("insertion"), NEW)
    # 0.5 m/s^2 and 5 mm/s at 1e6 counts/m: values 500000 * 1.6384e-4 and 5000 * 1.6384.
    assert [text.removeprefix("1 1 ") for text in line.received] == [
        "driver disable",
        "set accel 82",
        "set maxspeed 8192",
        "set limit.min -1000000000",
        "set limit.max 1000000000",
        "set knob.enable 0",
        "warnings clear",
        "warnings",
        "set pos 0",
        "get limit.home.state",
        "get limit.away.state",
        "get encoder.pos",
        "get pos",
    ]


def test_set_up_keeps_a_position_that_has_a_reference() -> None:
    line = Line()
    line.talk(line.protocol.set_up("insertion"), {**NEW, "warnings": "01 WH"})
    assert "1 1 set pos 0" not in line.received


def test_orders_are_point_moves_with_their_own_speed() -> None:
    line = Line().ready()
    line.protocol.power("insertion", True)
    line.protocol.move_to("insertion", 1200, 10_000)
    line.protocol.move_to("rotation", -5, 1)
    line.protocol.stop("rotation")
    line.protocol.power("insertion", False)
    assert line.sent() == (
        b"/1 1 0 driver enable:FB\n/1 1 0 move abs 1200 16384:F8\n/2 1 0 move abs -5 2:2C\n"
        b"/2 1 0 stop:47\n/1 1 0 driver disable:8E\n"
    )
    line.talk(line.protocol.write_limits("rotation", -100, 200), {})
    assert line.received == ["2 1 set limit.min -100", "2 1 set limit.max 200"]
    line.talk(line.protocol.release("rotation"), {})
    assert line.received[-1] == "2 1 driver disable"


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
    for number, insertion, rotation in (
        (4, [home], []),
        (5, [away], []),
        (6, [home], []),
        (7, [warnings], [warnings]),
    ):
        line.protocol.request(number)
        sent = re.findall(r"/(\d) 1 (\d+) (.*):..\n", line.sent().decode())
        assert sent == [
            (device, str(message_id), text)
            for device, slow in (("1", insertion), ("2", rotation))
            for message_id, text in zip(
                (1 + number, 34 + number), ["get encoder.pos", *slow], strict=False
            )
        ]


@pytest.mark.parametrize(("method", "asks"), [(17, True), (37, False)])
def test_a_rotation_homed_where_it_stands_has_no_switches(method: int, asks: bool) -> None:
    line = Line(rotation_homing_method=method)
    line.talk(line.protocol.set_up("rotation"), NEW)
    assert ("2 1 get limit.home.state" in line.received) is asks


def test_positions_are_measured_by_the_encoder_in_counts_of_the_moves() -> None:
    line = Line().ready()
    line.protocol.request(5)
    line.answer(5)
    # After set-up the count was 1000 where the encoder had 900.
    state = DriveReply(1000, moving=False, powered=True, home_switch=True)
    rotation = DriveReply(1000, moving=False, powered=True)
    assert line.statuses == [(5, {"insertion": state, "rotation": rotation})]


@pytest.mark.parametrize("lack", [None, "NA"])
def test_a_device_without_encoder_and_sensors_counts_its_steps(lack: str | None) -> None:
    lacks = ("get limit.home.state", "get limit.away.state", "get encoder.pos", "set knob.enable 0")
    line = Line().ready({**NEW, **dict.fromkeys(lacks, lack)})
    line.protocol.request(4)
    assert re.findall(r"\d+ ([a-z].*):", line.sent().decode()) == ["get pos"] * 2
    line.answer(4)
    assert line.statuses[0][1]["insertion"] == DriveReply(900, moving=False, powered=True)


@pytest.mark.parametrize(
    ("flag", "status", "powered", "fault", "rebooted"),
    [
        ("--", "BUSY", True, "", False),
        ("WR", "IDLE", True, "", True),
        ("FO", "IDLE", False, "", False),
        ("FS", "IDLE", True, "stalled and stopped (FS)", False),
        ("FV", "IDLE", False, "measured a supply voltage out of range (FV)", False),
        ("FX", "IDLE", True, "reports a fault (FX)", False),
        ("NC", "BUSY", True, "is moved by its knob (NC)", False),
        ("NC", "IDLE", True, "", False),
    ],
)
def test_warning_flags(flag: str, status: str, powered: bool, fault: str, rebooted: bool) -> None:
    line = Line().ready()
    line.protocol.request(5)
    line.answer(5, flag=flag, status=status)
    assert line.statuses[0][1]["rotation"] == DriveReply(
        1000, status == "BUSY", powered, fault=fault, rebooted=rebooted
    )


def test_a_restart_shows_behind_a_higher_flag() -> None:
    line = Line().ready()
    line.protocol.request(7)
    line.receive("@01 1 08 OK IDLE WV 900", "@01 1 41 OK IDLE WV 02 WV WR")
    line.receive("@02 1 08 OK IDLE WV 900", "@02 1 41 OK IDLE WV 01 WV")
    states = line.statuses[0][1]
    assert states["insertion"].rebooted
    assert not states["rotation"].rebooted
    line.talk(line.protocol.clear_fault("insertion"), {})
    assert line.received[-1] == "1 1 warnings clear"


def test_switches_follow_their_requests() -> None:
    line = Line().ready()
    for number, state in ((4, "0"), (5, "1")):
        line.protocol.request(number)
        for device in (1, 2):
            line.receive(
                f"@0{device} 1 {1 + number:02} OK BUSY -- 900",
                f"@0{device} 1 {34 + number} OK BUSY -- {state}",
            )
    reply = line.statuses[1][1]["insertion"]
    assert (reply.home_switch, reply.inner_switch) == (False, True)


COMPLETE = (
    "@01 1 08 OK IDLE -- 900",
    "@01 1 41 OK IDLE -- 0",
    "@02 1 08 OK IDLE -- 900",
    "@02 1 41 OK IDLE -- 0",
)


# For either axis, and for either command.
@pytest.mark.parametrize("lost", [0, 3])
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
def test_an_incomplete_or_wrong_answer_is_none(lost: int, instead: bytes) -> None:
    line = Line().ready()
    line.protocol.request(7)
    line.receive(*(text for index, text in enumerate(COMPLETE) if index != lost))
    line.receive_bytes(instead)
    assert line.statuses == []
    line.receive(COMPLETE[lost])
    assert len(line.statuses) == 1


def test_a_rejected_order_is_a_fault_until_it_is_acknowledged() -> None:
    line = Line().ready()
    line.receive("@02 1 00 RJ IDLE -- BADDATA", "@02 1 00 OK BUSY -- 0")
    line.protocol.request(5)
    line.answer(5)
    states = line.statuses[0][1]
    assert states["rotation"].fault == "refused an order: BADDATA"
    assert states["insertion"].fault == ""
    line.talk(line.protocol.clear_fault("rotation"), {})
    line.protocol.request(6)
    line.answer(6)
    assert line.statuses[1][1]["rotation"].fault == ""


def test_a_rejected_setting_and_silence_are_errors() -> None:
    line = Line()
    with pytest.raises(DriveError, match="device 2 refuses 'set accel 16': BADCOMMAND"):
        line.talk(line.protocol.set_up("rotation"), {**NEW, "set accel 16": None})
    before = line.link.now
    with pytest.raises(DriveError, match=r"no answer to '/1 1 \d\d driver disable"):
        line.talk(line.protocol.release("insertion"), None)
    assert 0.5 <= line.link.now - before < 0.6


@pytest.mark.parametrize("text", ["", "0", "100", "1 0", "1 10", "a", "1,2"])
def test_a_wrong_device_is_refused(text: str) -> None:
    with pytest.raises(UserError, match=f"zaber_rotation_device {text!r}"):
        Line(zaber_rotation_device=text)


def test_two_axes_of_one_device() -> None:
    line = Line(zaber_rotation_device="1 2")
    line.protocol.stop("rotation")
    assert line.sent().startswith(b"/1 2 0 stop")
    with pytest.raises(UserError, match="same axis"):
        Line(zaber_rotation_device="1 1")
