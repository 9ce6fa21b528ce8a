"""What the driver sends in a whole stepwise run: the frozen transcript (tests/oracles/can)."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from needle_bags.reading.bag_files import read_messages
from needle_core.can_frame import CanFrame
from needle_device_driver.supervisor.command import Command, CommandPoint
from needle_device_driver.supervisor.reports import StepResult
from needle_sim.drive_emulator_parameters import DriveEmulatorParameters
from needle_sim.drives.emulated_bus import EmulatedBus, MotionClock

from .driven_bench import DrivenBench

ORACLES = Path(__file__).resolve().parents[5] / "tests" / "oracles"
COMMANDS = "/device/joint_trajectory"
# How long driver and drives wait for each other in lock step [s].
WATCHDOG = 5.0
# Who a drive is, asked until it answers and again before lock step: how often is no matter.
WHO_ARE_YOU = ("40001000", "40081000", "60000000", "70000000")
SDO = {"insertion": "601", "rotation": "602"}


class Run(DrivenBench):
    """Driver and drives of `simulate --level drive`, whose motors move with SYNC.

    Attributes
    ----------
    sent : dict of str to list of str
        COB-ID to the data of all frames that the driver has sent.
    """

    def __init__(self) -> None:
        super().__init__(watchdog=WATCHDOG, lock_step=True)
        emulator = DriveEmulatorParameters()
        self.bus = EmulatedBus(emulator.insertion, emulator.rotation, MotionClock.SYNC, self.now)
        self.pass_time(1.0)
        self.sent: dict[str, list[str]] = {}
        take = self.bus.receive

        def tapped(frame: CanFrame, now: float) -> None:
            self.sent.setdefault(f"{frame.identifier:03X}", []).append(frame.data.hex().upper())
            take(frame, now)

        self.bus.receive = tapped  # type: ignore[method-assign]

    def go(self, insertion: float, rotation: float, duration: float) -> None:
        """Send a command and wait for its end."""
        point = CommandPoint((insertion, rotation), (), duration)
        names = ("insertion_joint", "rotation_joint")
        self.supervisor.submit(Command(self.ros_ns, names, (point,)), self.now)
        while not any(isinstance(e, StepResult) for e in self.supervisor.take_events()):
            self.cycle(1, hold=1.0)


def frozen(cob_id: str) -> list[str]:
    lines = (ORACLES / "can" / "drive_best.txt").read_text("utf-8").splitlines()
    return [line.partition("#")[2] for line in lines if line.startswith(cob_id)]


def distinct(data: list[str]) -> list[str]:
    return [each for each, _ in itertools.groupby(data)]


def known(requests: list[str]) -> list[str]:
    return [request for request in requests if not request.startswith(WHO_ARE_YOU)]


@pytest.fixture(scope="module")
def run() -> Run:
    """The frozen run's commands, once more."""
    run = Run()
    run.home()
    run.enable()
    for _, _, command in read_messages(ORACLES / "bags" / "drive_best", COMMANDS.__eq__):
        (point,) = command.points
        insertion, rotation = map(float, point.positions)
        duration = point.time_from_start
        run.go(insertion, rotation, duration.sec + duration.nanosec * 1e-9)
    run.close()
    return run


@pytest.mark.parametrize("axis", SDO)
def test_each_drive_is_told_and_asked_the_same(run: Run, axis: str) -> None:
    assert known(run.sent[SDO[axis]]) == known(frozen(SDO[axis]))


@pytest.mark.parametrize("cob_id", ["201", "202", "301", "302"])
def test_process_data_are_the_same(run: Run, cob_id: str) -> None:
    assert distinct(run.sent[cob_id]) == frozen(cob_id)
