"""Step/direction board: its lines, dead-man, lost lines and lost steps, and the sketch itself."""

from __future__ import annotations

import shutil
import subprocess
from functools import reduce
from pathlib import Path

import pytest

from needle_sim.drives.motor import MotorSettings
from needle_sim.drives.stepdir_drives import StepdirDrives

SKETCH = Path(__file__).parents[3] / "needle_device_driver/firmware/stepdir/stepdir.ino"
ARDUINO = Path(__file__).parent / "arduino"
ON, MOVING, OUTER, INNER, SET_UP = 1, 2, 4, 8, 16
POSITIONS = (1, 3)  # fields of the status


class Computer:
    """Computer that numbers its lines, and a board that has booted."""

    def __init__(self, **motor: float) -> None:
        insertion = MotorSettings(1.6e6, 1e9, **{"start": 1000.0, "travel": 400_000.0, **motor})
        motors = {"insertion": insertion, "rotation": MotorSettings(1000.0, 1e9, lag=0.005)}
        self.board = StepdirDrives(motors, -1.0)
        self.now = 0.0
        self.number = 0

    def send(self, body: str, after: float = 0.0, skip: int = 0) -> str:
        self.now += after
        text = f"{self.number + skip},{body}"
        self.number += 1 + skip
        sent = f"${text}*{reduce(lambda total, c: total ^ ord(c), text, 0):02X}\n"
        return b"".join(self.board.receive((sent.encode(),), self.now)).decode()

    def status(self, after: float = 0.0) -> list[int]:
        """Return fault, position, flags, position, flags."""
        return [int(field) for field in self.send("S", after)[:-4].split(",")[2:]]

    def switch_on(self, *axes: int) -> None:
        for axis in axes:
            self.send(f"C,{axis},800000,-1,100")
            self.send(f"P,{axis},1")

    def wait(self, seconds: float) -> list[int]:
        """Beat for some time; return the status."""
        for _ in range(round(seconds / 0.05)):
            self.send("B", 0.05)
        return self.status()

    @property
    def place(self) -> float:
        return self.board.axes(self.now)["insertion"].position


def test_a_transcript() -> None:
    board = StepdirDrives({"insertion": MotorSettings(1.6e6, 1e9)}, -1.0)
    for time, sent, expected in (
        (0.000, b"$0,I*55\n", b"$0,I,Emulated stepdir,1,100000*21\n"),
        (0.001, b"$1,C,0,800000,-1,100*4B\r\n$2,S*4D\n", b"$1,C*5E\n$2,S,0,0,16,0,0*66\n"),
        (0.002, b"$3,P,0,1*4E\n$4,M,0,100", b""),
        (0.003, b",25*7F\n$5,S*4A\n", b"$5,S,0,0,19,0,0*6E\n"),
        (0.040, b"$6,S*49\n", b"$6,S,0,100,17,0,0*62\n"),
    ):
        assert b"".join(board.receive((sent,), time)) == expected


def test_a_silent_computer_stops_the_board_within_100_ms_and_the_ramp() -> None:
    computer = Computer()
    computer.switch_on(0, 1)
    computer.send("M,0,100000,12500")
    computer.send("M,1,100000,12500", after=0.02)
    begin = computer.place
    fault, _, flags, _, other = computer.status(after=1.0)
    assert (fault, flags, other) == (1, ON | SET_UP, ON | SET_UP)
    # 8000 steps/s for at most 100 ms, then the ramp: v^2 / 2 a.
    way = (computer.place - begin) * 1.6e6
    assert way == pytest.approx(8000 * 0.101 + 8000**2 / 1.6e6, abs=20)
    computer.send("M,0,100000,12500")
    assert computer.wait(0.2)[2] & MOVING == 0
    computer.send("R")
    assert computer.wait(0.2)[0:3:2] == [0, ON | SET_UP]


@pytest.mark.parametrize("skip", [1, -1])
def test_a_lost_or_foreign_line_stops_both_axes(skip: int) -> None:
    computer = Computer()
    computer.switch_on(0, 1)
    computer.send("M,0,100000,12500")
    computer.send("M,1,100000,12500", after=0.02)
    computer.send("B", after=0.02, skip=skip)
    fault, position, flags, _, other = computer.status(after=0.05)
    assert (fault, flags, other) == (2, ON | SET_UP, ON | SET_UP)
    assert 8000 * 0.03 < position < 8000 * 0.05 + 50


@pytest.mark.parametrize(
    ("start", "target", "switch"), [(100.0, -5000, OUTER), (399_900.0, 5000, INNER)]
)
def test_a_switch_blocks_its_direction_only(start: float, target: int, switch: int) -> None:
    computer = Computer(start=start)
    computer.switch_on(0)
    computer.send(f"M,0,{target},625")
    _, position, flags, *_ = computer.wait(0.2)
    assert flags == ON | SET_UP | switch
    assert 100 < abs(position) < 160
    computer.send("M,0,0,25")
    assert computer.wait(0.2)[1:3] == [0, ON | SET_UP]


@pytest.mark.skipif(not shutil.which("g++"), reason="compiles the sketch")
def test_the_sketch_answers_as_the_emulated_board(tmp_path: Path) -> None:
    bench = tmp_path / "bench"
    sketch = f'-DSKETCH="{SKETCH}"'
    argv = ["g++", "-O0", "-Wall", "-Wextra", "-Werror", sketch, str(ARDUINO / "bench.cpp")]
    subprocess.run([*argv, "-o", str(bench)], check=True)
    computer = Computer()
    script: list[str] = []
    emulated: list[str] = []

    def send(body: str, after: float, skip: int = 0) -> None:
        text = f"{computer.number + skip},{body}"
        checksum = reduce(lambda total, c: total ^ ord(c), text, 0)
        emulated.append(computer.send(body, after, skip).strip())
        script.append(f"{round(computer.now * 1e6)} ${text}*{checksum:02X}\n")

    for body in ("S", "C,0,800000,-1,100", "C,1,100000,1,200", "P,0,1", "P,1,1", "M,0,100,25", "S"):
        send(body, 0.001)
    for body in ("M,0,2000,250", "M,1,-300,100", *["S"] * 12, "H,0", "S", "M,0,50,300"):
        send(body, 0.02)
    for body in (*["S"] * 20, "M,0,3000,150", *["S"] * 3):
        send(body, 0.02)
    send("S", 0.4)  # The dead-man acts.
    for body in ("R", "M,1,200,170", "S"):
        send(body, 0.02)
    for body, skip in (("B", 3), ("S", 0), ("P,0,0", 0), ("S", 0), ("C,0,0,1,100", 0), ("X", 0)):
        send(body, 0.02, skip)
    found = subprocess.run(
        [bench], input="".join(script), text=True, capture_output=True, check=True
    ).stdout.splitlines()
    assert len(found) == 1 + sum(map(bool, emulated))
    for real, ours in zip(found, filter(None, emulated), strict=False):
        number, letter, *fields = real[1:-3].split(",")
        expected = ours[1:-3].split(",")
        assert [number, letter] == expected[:2]
        if letter == "S":
            # The dead-man acts within a motion step, and then the ramps differ in rounding.
            assert [int(field) for field in fields] == [
                pytest.approx(int(field), abs=20 if index in POSITIONS else 0)
                for index, field in enumerate(expected[2:])
            ]
    assert [bool(answer) for answer in emulated[-4:]] == [False, True, False, False]
