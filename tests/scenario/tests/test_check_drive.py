"""check_drive on emulated drives."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from needle_core.can_frame import CanFrame
from needle_core.component import PortChange
from needle_core.runners.paced import PacedRunner
from needle_device_driver import check_drive, parameters
from needle_device_driver.cia402.backend import BACKEND
from needle_sim.drive_emulator import DriveEmulator, DriveEmulatorParameters

PACE = 50.0


class EmulatedPort:
    """A port with emulated drives behind it; their time advances with each batch."""

    def __init__(self, **settings: Any) -> None:
        self.bus = DriveEmulator(DriveEmulatorParameters(**settings)).bus
        self.now = 0.0
        self.positions: set[float] = set()

    def open(self, arrive: Callable[[Any], None]) -> None:
        self.arrive = arrive
        arrive(PortChange(""))

    def send(self, batch: tuple[CanFrame, ...]) -> None:
        self.now += 0.01
        self.positions |= {axis.position for axis in self.bus.axes(self.now).values()}
        if replies := self.bus.receive(batch, self.now) + self.bus.poll(self.now):
            self.arrive(tuple(replies))

    def close(self) -> None:
        self.arrive = lambda _: None


@pytest.fixture
def checked(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str]]:
    """Run check_drive on a port; return its exit code and output."""
    file = tmp_path / "drives.yaml"
    file.write_text("device_driver: {ros__parameters: {channel: can, connect_timeout: 2.0}}\n")

    def check(port: EmulatedPort) -> tuple[int, str]:
        monkeypatch.setattr(check_drive, "PacedRunner", partial(PacedRunner, pace=PACE))
        backend = partial(type(BACKEND), BACKEND.port, BACKEND.settings, BACKEND.make)
        backends = {**parameters.BACKENDS, "cia402": backend(lambda _: port)}
        monkeypatch.setattr(parameters, "BACKENDS", backends)
        code = check_drive.main(["--params", str(file)])
        captured = capsys.readouterr()
        return code, captured.out + captured.err

    return check


def test_connected_drives_are_described_and_do_not_move(
    checked: Callable[..., tuple[int, str]],
) -> None:
    port = EmulatedPort(boot_time=0.0, insertion_start=0.01)
    code, output = checked(port)
    assert code == 0
    assert "look_ahead            within 0.33 mm\n" in output
    assert "drive_watchdog        within 0.33 mm\n" in output
    assert port.positions == {0.01, 0.0}
    assert {drive.state.name for drive in port.bus.drives.values()} == {"SWITCH_ON_DISABLED"}


def test_absent_drives_are_an_error(checked: Callable[..., tuple[int, str]]) -> None:
    port = EmulatedPort()
    port.bus.is_cut = True
    code, output = checked(port)
    assert code == 2
    assert output == "error: insertion axis: node 1 does not answer (read 0x1000:0 device type)\n"
