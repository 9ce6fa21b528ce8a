"""Emulated Zaber devices against byte transcripts of public code, and their faults."""

from __future__ import annotations

import pytest

from needle_sim.drives.motor import MotorSettings
from needle_sim.drives.zaber_drives import ZaberDrives

SCALE = 1e6
"""Counts per metre."""
TRAVEL = 0.1
# Data values of 20 mm/s and of 0.5 m/s^2.
SPEED, RAMP = 32768, 82


class Chain:
    """A computer on a chain whose insertion device is 1 mm from its home sensor."""

    def __init__(self, **motor: float) -> None:
        insertion = MotorSettings(
            SCALE, 0.05 * SCALE, **{"start": 0.001 * SCALE, "travel": TRAVEL * SCALE, **motor}
        )
        motors = {"insertion": insertion, "rotation": MotorSettings(1000.0, 20_000.0)}
        self.drives = ZaberDrives(motors, -1.0)
        self.now = 0.0

    def send(self, line: str, after: float = 0.0) -> str:
        self.now += after
        sent = f"/{line}\n".encode()
        return b"".join(self.drives.receive((sent,), self.now)).decode()

    def value(self, name: str, after: float = 0.0) -> float:
        return float(self.send(f"1 1 get {name}", after).split()[-1])

    def homed(self) -> Chain:
        self.send("1 set maxspeed 32768")
        self.send(f"1 set accel {RAMP}")
        self.send("1 home")
        self.now += 1.0
        assert "WR" not in self.send("1 warnings")
        return self

    @property
    def place(self) -> float:
        return self.drives.axes(self.now)["insertion"].position


def test_the_transcript_of_public_code() -> None:
    chain = Chain()
    for after, sent, expected in (
        (0.0, "1 0", "@01 0 OK IDLE WR 0"),
        (0.0, "01 warnings", "@01 0 OK IDLE WR 01 WR"),
        (0.0, "01 home", "@01 0 OK BUSY WR 0"),
        (1.0, "1 0", "@01 0 OK IDLE -- 0"),
        (0.0, "01 warnings", "@01 0 OK IDLE -- 00"),
        (0.0, "1 1 move abs 10000", "@01 1 OK BUSY -- 0"),
        (0.1, "01 1 stop", "@01 1 OK BUSY -- 0"),
        (1.0, "1 0 stop", "@01 0 OK IDLE -- 0"),
        (0.0, "1 1 move abs 50000", "@01 1 OK BUSY -- 0"),
        (0.1, "1 1 move abs 20000", "@01 1 OK BUSY NI 0"),
        (0.1, "01 1 stop", "@01 1 OK BUSY NI 0"),
        (1.0, "01 warnings", "@01 0 OK IDLE NI 01 NI"),
        (0.0, "1 1 move abs 0", "@01 1 OK BUSY -- 0"),
        (3.0, "1 0 get pos", "@01 0 OK IDLE -- 0"),
        (0.0, "1 0 get limit.cycle.dist", "@01 0 RJ IDLE -- BADCOMMAND"),
        (0.0, "1 1 move abs far", "@01 1 RJ IDLE -- BADDATA"),
        (0.0, "1 2 get pos", "@01 2 RJ IDLE -- BADAXIS"),
        (0.0, "1 0 12", "@01 0 12 OK IDLE -- 0"),
        (0.0, "get system.serial", "@01 0 OK IDLE -- 0\r\n@02 0 OK IDLE WR 0"),
        (0.0, "1 set comm.checksum 1", "@01 0 OK IDLE -- 0:8D"),
        (0.0, "1 0 12:FC", "@01 0 12 OK IDLE -- 0:0A"),
    ):
        assert chain.send(sent, after) == f"{expected}\r\n", sent


@pytest.mark.parametrize("line", ["1 0 12:FD", "3 get pos"])
def test_a_wrong_checksum_and_another_address_have_no_answer(line: str) -> None:
    assert Chain().send(line) == ""


def test_speed_and_ramp_have_the_protocols_units() -> None:
    chain = Chain().homed()
    chain.send(f"1 1 move abs 50000 {SPEED // 2}")
    assert chain.drives.axes(chain.now + 0.015)["insertion"].velocity == pytest.approx(
        0.0075, abs=0.0006
    )
    chain.now += 1.0
    assert chain.drives.axes(chain.now)["insertion"].velocity == pytest.approx(0.01, rel=1e-3)


def test_without_a_reference_no_outward_motion_is_accepted() -> None:
    chain = Chain()
    assert chain.value("pos") == TRAVEL * SCALE
    assert chain.send("1 1 move rel 1") == "@01 1 RJ IDLE WR BADDATA\r\n"
    assert " OK BUSY WR" in chain.send("1 1 move rel -10")
    chain.send("1 1 set pos 0", 0.1)
    assert chain.send("1 1 move rel 1") == "@01 1 OK BUSY WH 0\r\n"


def test_a_limit_sensor_ends_a_move() -> None:
    chain = Chain().homed()
    chain.send("1 set limit.min -9000")
    chain.send("1 1 move abs -5000")
    assert chain.send("1 1", 1.0) == "@01 1 OK IDLE WL 0\r\n"
    assert chain.value("limit.home.state") == 1
    assert chain.value("limit.away.state") == 0
    assert abs(chain.place) < 1e-3
    chain.send("1 1 move abs 5000")
    assert chain.value("pos", 1.0) == 5000
    assert chain.value("limit.home.state") == 0
    assert "01 WL" in chain.send("1 warnings clear")
    assert chain.send("1 warnings") == "@01 0 OK IDLE -- 00\r\n"


def test_a_stall_is_measured_and_acknowledged() -> None:
    chain = Chain().homed()
    chain.send("1 1 move abs 50000")
    chain.now += 0.5
    blocked = chain.place
    chain.drives.stall("insertion")
    assert chain.send("1 1", 0.3) == "@01 1 OK IDLE FS 0\r\n"
    assert chain.value("pos") == chain.value("encoder.pos") == round(chain.place * SCALE)
    assert chain.place == pytest.approx(blocked)
    chain.drives.restore(chain.now)
    assert chain.send("1 1 move abs 0") == "@01 1 OK BUSY FS 0\r\n"
    chain.send("1 warnings clear", 3.0)
    assert chain.send("1 1 get pos") == "@01 1 OK IDLE -- 0\r\n"
