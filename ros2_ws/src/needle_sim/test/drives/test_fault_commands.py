"""Faults on command at the terminal of drive_emulator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from needle_core.component import Action, Log, Moment, Send
from needle_core.errors import UserError
from needle_sim.drive_emulator import (
    ADAPTERS,
    COMMAND_LINES,
    DriveEmulator,
    DriveEmulatorParameters,
)
from needle_sim.drives.emulated_bus import EmulatedBus

AT = Moment(1.0, 1_000_000_000)


@pytest.fixture
def drives() -> DriveEmulator:
    emulator = DriveEmulator(DriveEmulatorParameters())
    # Both drives have booted.
    list(emulator.timers[0].handler(AT))
    return emulator


def typed(drives: DriveEmulator, *lines: str) -> list[Action]:
    (terminal,) = (port for port in drives.ports if port.name == COMMAND_LINES)
    return list(terminal.handler(lines, AT))


@pytest.mark.parametrize(
    ("line", "happened"),
    [
        ("stall insertion", lambda bus: bus.drives["insertion"].motor.stalled),
        ("hang rotation", lambda bus: bus.drives["rotation"].hung),
        ("emcy insertion 0x2310", lambda bus: bus.drives["insertion"].error_code == 0x2310),
        ("cut_bus", lambda bus: bus.is_cut),
        ("reboot rotation", lambda bus: bus.drives["rotation"].state.name == "NOT_READY"),
    ],
)
def test_a_fault_happens_on_command_and_ends_with_restore(
    drives: DriveEmulator, line: str, happened: Callable[[EmulatedBus], bool]
) -> None:
    (log, *_) = typed(drives, line)
    assert log == Log("warning", f"on command: {line}, at 0.000000 mm, 0.000000 rad")
    assert happened(drives.bus)
    typed(drives, "restore")
    assert happened(drives.bus) == line.startswith(("emcy", "reboot"))


def test_the_adapter_is_unplugged_and_plugged_in_on_command(drives: DriveEmulator) -> None:
    actions = typed(drives, "unplug", "restore")
    orders = [action.batch for action in actions if isinstance(action, Send)]
    assert orders == [(False,), (True,)]
    assert {action.port for action in actions if isinstance(action, Send)} == {ADAPTERS}


def test_invalid_command_lines_are_reported_and_ignored(drives: DriveEmulator) -> None:
    bad = (
        *("explode", "stall", "stall both", "stall insertion now", "cut_bus now"),
        *("emcy insertion x", "emcy rotation 0x10000"),
    )
    actions = typed(drives, *bad)
    assert [action.text.split("'")[1] for action in actions if isinstance(action, Log)] == list(bad)
    assert len(actions) == len(bad)
    assert {drive.error_code for drive in drives.bus.drives.values()} == {0}


def test_invalid_drive_settings_are_rejected() -> None:
    unknown = ({"drives": names} for names in ("gallil", "cia402,", "cia402,cia402,cia402"))
    bad: Any
    for bad in ({"insertion_node_id": 2}, {"insertion_start": 0.3}, *unknown):
        with pytest.raises(UserError, match=r"node id|beyond|is unknown; known: cia402|at most 2"):
            DriveEmulator(DriveEmulatorParameters(**bad))
