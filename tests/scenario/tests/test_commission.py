"""The script of commission on emulated drives, with a person who follows its instructions."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from functools import partial

import pytest

from needle_bringup.commission import _BY_HAND, _WITH_PEDAL, Row, commission, report
from needle_core.errors import UserError
from needle_device_driver.cia402 import backend
from needle_device_driver.conformance.faults import FAULTS
from needle_device_driver.conformance.rig import DRIVER, ConformanceRig
from needle_device_driver.procedure import Procedure

BY_HAND = _BY_HAND | _WITH_PEDAL
EVENTS = {BY_HAND[fault.name]: fault.event for fault in FAULTS if fault.name in BY_HAND}


class Person:
    """A person who answers, and follows each instruction one second later."""

    def __init__(self, rig: ConformanceRig, scale: float = 1.0) -> None:
        self.rig, self.scale = rig, scale
        self.asked: list[str] = []

    def _do(self, event: Callable[[ConformanceRig], object]) -> None:
        event(self.rig)

    def __call__(self, text: str) -> str:
        self.asked.append(text)
        rig = self.rig
        for what, event in EVENTS.items():
            if what in text:
                rig.runner.timeline.call_after(1.0, partial(self._do, event))
        if text == "Undo it.":
            rig.runner.run(0.5)
            for port, drives in rig.drives.connections.items():
                drives.restore(rig.runner.now)
                rig.runner.open_port(DRIVER, port)
        return str(10.0 * self.scale) if "Measure it" in text else ""


def test_each_stop_is_measured_within_its_bound() -> None:
    rig = ConformanceRig(1, drives={"insertion_start": 0.001})
    person = Person(rig)
    rows = list(commission(rig, person))
    assert [row for row in rows if not row.passed] == []
    rules = ["no_motion_by_itself", "counts_per_unit", "hold_to_run", "hold_age", "estop_latches"]
    rules += ["quick_stop", "drive_watchdog", "link_loss", "drive_reboot", "following_error"]
    assert [row.rule for row in rows] == rules
    measured = {row.rule: row.measured for row in rows}
    # 5 mm/s for 0.1 s, the lifetime of the operator's hold.
    assert 0.3e-3 < measured["hold_age"] < 0.8e-3
    assert all(0.0 < measured[rule] < 0.3e-3 for rule in ("hold_to_run", "quick_stop", "link_loss"))
    assert rig.state == "DISABLED"
    assert sum("During the motion" in text for text in person.asked) == 3


def test_a_person_with_a_pedal_also_releases_and_unplugs_it() -> None:
    rig = ConformanceRig(1, drives={"insertion_start": 0.001})
    person = Person(rig)
    rows = list(commission(rig, person, has_pedal=True))
    assert [row for row in rows if not row.passed] == []
    assert sum("During the motion" in text for text in person.asked) == 5


def test_real_drives_move_only_while_a_person_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    def are_emulated(*_: object) -> Procedure[bool]:
        yield from ()
        return False

    monkeypatch.setattr(backend, "are_emulated", are_emulated)
    rig = ConformanceRig(1)
    begin = rig.positions
    with pytest.raises(UserError, match="only while a person holds"):
        list(commission(rig, Person(rig)))
    assert rig.positions == begin


def test_a_wrong_scale_and_a_long_distance_do_not_pass() -> None:
    rig = ConformanceRig(1, drives={"insertion_start": 0.001})
    rows = commission(rig, Person(rig, scale=1.05))
    assert next(rows).passed
    assert not next(rows).passed
    text = report([Row("link_loss", "unplugged", 0.5e-3, 0.3e-3)], "A. Person", datetime.date.min)
    assert "| `link_loss` | unplugged | 0.500 | 0.300 | NO |" in text
    assert "Carried out by A. Person" in text


@pytest.mark.parametrize("measured", [0.1, float("nan")])
def test_an_unknown_distance_is_not_a_failure(measured: float) -> None:
    assert Row("", "", measured, 0.2).passed
