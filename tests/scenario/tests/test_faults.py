"""Schedules: drawn from the vocabulary, read as written, shrunk to the relevant faults."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_core.errors import UserError
from scenario import faults
from scenario.faults import VOCABULARY, Fault, Kind, draw_schedule, read_schedule, write_schedule
from scenario.shrinking import shrink


def test_every_part_gets_every_kind_of_its_faults() -> None:
    drawn = [fault for seed in range(2000) for fault in draw_schedule(seed)]
    known = {(part, kind) for part, kinds in VOCABULARY.items() for kind in kinds}
    assert {(fault.part, fault.kind) for fault in drawn} == known
    floods = {faults.rogue_topic(fault) for fault in drawn if fault.part == faults.FLOOD}
    assert floods == set(faults.ROGUE_TOPICS)


def test_an_additional_part_changes_no_fault_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    with_all = [draw_schedule(seed) for seed in range(50)]
    monkeypatch.delitem(faults._DRAWN_ALONE, faults.PAGE)
    for seed, drawn in enumerate(with_all):
        assert [fault for fault in drawn if fault.part != faults.PAGE] == draw_schedule(seed)


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
