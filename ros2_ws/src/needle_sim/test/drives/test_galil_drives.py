"""Galil controller: its replies, position tracking, limits, and a program on its thread."""

from __future__ import annotations

import re

import pytest

from needle_sim.drives.galil_drives import GalilDrives
from needle_sim.drives.motor import MotorSettings

# Bits of TS: moving, position error, off, and limit switches that are not active.
MOVING, ERROR, OFF, NO_FORWARD, NO_REVERSE = 0x80, 0x40, 0x20, 0x08, 0x04
NO_SWITCH = NO_FORWARD | NO_REVERSE
# Stops channel A 50 to 60 ms after `alive` was set to 5.
DEAD_MAN = b"#DEAD\ralive=alive-1\rWT 10\rJP #DEAD,alive>0\rSTA\r#WAIT\rJP #WAIT,_BGA>0\rMOA\rEN"


class Computer:
    """Computer on a controller that has booted; its insertion motor has switches."""

    def __init__(self, **motor: float) -> None:
        insertion = MotorSettings(1e6, 1e9, **{"start": 2000.0, "travel": 12_000.0, **motor})
        motors = {"insertion": insertion, "rotation": MotorSettings(1000.0, 1e9)}
        self.controller = GalilDrives(motors, -1.0)
        self.now = 0.0

    def send(self, text: str | bytes, after: float = 0.0) -> str:
        """Send a line, or bytes, after some time; return the replies."""
        self.now = round(self.now + after, 6)
        data = text if isinstance(text, bytes) else f"{text}\r".encode()
        return b"".join(self.controller.receive((data,), self.now)).decode()

    def read(self, *operands: str, after: float = 0.0) -> list[int]:
        reply = self.send(f"MG {','.join(operands)}", after)
        return [round(float(value)) for value in re.findall(r"-?[\d.]+", reply)]

    def track(self, *orders: str) -> None:
        """Switch A on in position tracking; all orders must be accepted."""
        line = ["SHA", "ACA=10240000", "DCA=10240000", "SPA=10000", "PTA=1", *orders]
        assert self.send(";".join(line)) == ":" * len(line)


def test_a_transcript() -> None:
    computer = Computer()
    for sent, expected in (
        # Public transcripts: manuals DMC-2x00 p. 75, DMC-40x0; tmtsoftware/galil-prototype.
        (b"bg\r", "?"),
        (b"TC1\r", "1 Unrecognized command\r\n:"),
        (b"TC1\r", "0\r\n:"),
        (b"apple=10\rMG apple+5\r", ": 15.0000\r\n:"),
        (b"SHA;SPA=20", ""),
        (b"00\r\n", "::"),
        (b"MG _TPA,_TSA,_TSB\r", " 0.0000 12.0000 44.0000\r\n:"),
        (b"DL\r#DEMO\rEN\r", ""),
        (b"\\", "::"),
        (b"XQ#DEMO,1;MG _CN0\r", ": -1.0000\r\n:"),
        (b"\x12\x16\r", "Emulated DMC4020 Rev 1.2\r\n:"),
    ):
        assert computer.send(sent) == expected, sent


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("QQA=1", "1"),
        ("SPA=100;" * 11, "5"),
        ("SPA=0", "6"),
        ("MOA", "7"),
        ("MG unknown", "9"),
        ("XQ#NONE,2", "10"),
        ("DL", "17"),
        ("XQ#LOOP,1", "19"),
        ("BGB", "20"),
    ],
)
def test_a_refused_command_and_its_code(line: str, code: str) -> None:
    computer = Computer()
    computer.send(b"DL\r#LOOP\rWT 1\rJP #LOOP\r\\")
    if code != "10":
        computer.send("XQ#LOOP,1")
    computer.track("PAA=1000")
    assert computer.send(line, after=0.01).endswith("?")
    assert computer.send("TC1").split()[0] == code


def test_position_tracking_follows_new_targets_and_st_ends_it() -> None:
    computer = Computer()
    computer.track("PAA=1000")
    assert computer.read("_TPA", "_TSA", after=0.05) == [pytest.approx(495, abs=15), MOVING | 12]
    computer.send("PAA=200")
    # The mode stays active at the target.
    assert computer.read("_TPA", "_TSA", "_SCA", after=0.2) == [200, MOVING | NO_SWITCH, 0]
    assert computer.send("PAA=900;STA") == "::"
    assert computer.read("_TPA", "_TSA", "_SCA", after=0.1) == [200, NO_SWITCH, 4]
    # Without the mode, PA waits for BG.
    computer.send("PAA=800")
    assert computer.read("_TPA", after=0.1) == [200]
    computer.send("BGA")
    assert computer.read("_TPA", "_TSA", "_SCA", after=0.2) == [800, NO_SWITCH, 1]


@pytest.mark.parametrize(
    ("order", "code", "place", "back"),
    [
        ("PAA=-9000", 3, -2000, 0),
        ("FLA=500;PAA=9000", 2, 500, 0),
    ],
)
def test_a_limit_stops_the_axis_on_its_ramp(order: str, code: int, place: int, back: int) -> None:
    computer = Computer()
    computer.track("SDA=1024000", *order.split(";"))
    at, reason, status = computer.read("_TPA", "_SCA", "_TSA", after=1.4)
    # v^2 / 2 a at 10,000 counts/s; a limit is noticed up to 1 ms late.
    assert abs(at - place) == pytest.approx(10_000**2 / 2 / 1_024_000, abs=12)
    assert reason == code
    assert not status & MOVING
    # It moves away from the limit only.
    computer.send(f"PTA=1;{order.rpartition(';')[2]}")
    assert computer.read("_TPA", "_SCA", after=0.1) == [pytest.approx(at, abs=12), code]
    computer.send(f"PTA=1;PAA={back}")
    assert computer.read("_TPA", after=1.4) == [back]


@pytest.mark.parametrize(("enabled", "status"), [(1, OFF), (0, MOVING | ERROR)])
def test_a_position_error_switches_off(enabled: int, status: int) -> None:
    computer = Computer()
    computer.track("ERA=100", f"OEA={enabled}", "PAA=5000")
    computer.controller.stall("insertion")
    assert computer.read("_TSA", "_SCA", after=0.1) == [status | NO_SWITCH, 8 * enabled]


def test_a_program_stops_the_axis_without_the_computer() -> None:
    computer = Computer()
    assert computer.send(b"DL\r" + DEAD_MAN + b"\\") == "::"
    computer.track("PAA=50000")
    assert computer.send("alive=5;XQ#DEAD,1") == "::"
    for _ in range(10):
        computer.send("alive=5", after=0.04)
    assert computer.read("_TSA") == [MOVING | NO_SWITCH]
    begin = computer.read("_TPA")[0]
    end, status, line = computer.read("_TPA", "_TSA", "_XQ1", after=0.3)
    assert (status, line) == (OFF | NO_SWITCH, -1)
    # 50 to 60 ms at 10,000 counts/s, and the ramp.
    assert 500 <= end - begin <= 620


def test_a_restart_forgets_settings_program_and_position() -> None:
    computer = Computer()
    computer.send(b"DL\r" + DEAD_MAN + b"\\")
    computer.track("alive=100000", "XQ#DEAD,1", "PAA=1000")
    assert computer.read("_XQ1", "alive", after=0.5)[0] >= 0
    computer.controller.reboot("rotation", computer.now)
    assert computer.send("MG _TPA", after=0.1) == ""
    assert computer.read("_TPA", "_TSA", "_XQ1", "TIME", after=0.3) == [0, OFF | 12, -1, 400]
    assert computer.send("MG alive;XQ#DEAD,1;PAA=100") == "??:"
    assert computer.controller.axes(computer.now)["insertion"].position == pytest.approx(0.003)
