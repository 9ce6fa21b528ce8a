"""Schedules: read as written, shrunk to the relevant faults."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_core.errors import UserError
from scenario.faults import Fault, Kind, draw_schedule, read_schedule, write_schedule
from scenario.shrinking import shrink


def test_a_written_schedule_is_read_and_others_are_rejected(tmp_path: Path) -> None:
    drawn, file = draw_schedule(3), tmp_path / "one.json"
    write_schedule(file, 3, drawn, "because")
    assert read_schedule(file) == (3, drawn)
    for text in ("", "{}", '{"seed": 1, "faults": [{"part": "bus", "kind": "garbage"}]}'):
        file.write_text(text)
        with pytest.raises(UserError, match=r"one\.json"):
            read_schedule(file)


def test_irrelevant_faults_are_dropped() -> None:
    drawn = [Fault(part, Kind.OFF, 1.0, 2.0, 0.5) for part in ("operator", "/joy", "bus")]
    kept = shrink(drawn, lambda some: {"operator", "bus"} <= {fault.part for fault in some})
    assert [(fault.part, fault.lasts) for fault in kept] == [("operator", 1.0), ("bus", 1.0)]
