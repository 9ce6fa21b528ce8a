"""Schedules: drawn from the vocabulary alone, read as they were written, shrunk to what matters."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_core.errors import UserError
from scenario import faults
from scenario.faults import (
    PAGE,
    VOCABULARY,
    Fault,
    Kind,
    draw_schedule,
    read_schedule,
    write_schedule,
)
from scenario.shrinking import shrink


def test_every_part_is_spoilt_in_every_way_it_knows() -> None:
    drawn = {(fault.part, fault.kind) for seed in range(2000) for fault in draw_schedule(seed)}
    assert drawn == {(part, kind) for part, kinds in VOCABULARY.items() for kind in kinds}


def test_a_part_more_shifts_no_fault_of_another(monkeypatch: pytest.MonkeyPatch) -> None:
    with_all = [draw_schedule(seed) for seed in range(200)]
    others = {part: kinds for part, kinds in faults._DRAWN_ALONE.items() if part != PAGE}
    monkeypatch.setattr(faults, "_DRAWN_ALONE", others)
    assert any(with_all[seed] != draw_schedule(seed) for seed in range(200))
    for seed, drawn in enumerate(with_all):
        assert [fault for fault in drawn if fault.part != PAGE] == draw_schedule(seed)


def test_a_schedule_is_read_as_it_was_written(tmp_path: Path) -> None:
    drawn = draw_schedule(3)
    write_schedule(tmp_path / "one.json", 3, drawn, "because")
    assert read_schedule(tmp_path / "one.json") == (3, drawn)


@pytest.mark.parametrize(
    "text", ["", "{}", '{"seed": 1, "faults": [{"part": "operator", "kind": "reordered"}]}']
)
def test_what_is_no_schedule_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "one.json").write_text(text)
    with pytest.raises(UserError, match=r"one\.json"):
        read_schedule(tmp_path / "one.json")


def test_faults_that_do_not_matter_are_left_out() -> None:
    drawn = [Fault(part, Kind.OFF, 1.0, 2.0, 0.5) for part in ("operator", "/joy", "bus")]
    kept = shrink(drawn, lambda some: {"operator", "bus"} <= {fault.part for fault in some})
    assert [fault.part for fault in kept] == ["operator", "bus"]
    assert [fault.lasts for fault in kept] == [1.0, 1.0]


def test_a_flood_is_on_any_topic_that_a_stranger_may_publish_on() -> None:
    sizes = [(n + 0.5) / len(faults.STRANGE_TOPICS) for n in range(len(faults.STRANGE_TOPICS))]
    floods = [Fault(faults.FLOOD, Kind.WRONG, 0.0, 1.0, size) for size in sizes]
    assert [faults.strange_topic(flood) for flood in floods] == list(faults.STRANGE_TOPICS)
    for part, topic in (
        (f"{faults.STRANGER}/joint_states", "/joint_states"),
        (f"{faults.STRANGER}/device/home", ""),
        ("/joint_states", ""),
    ):
        assert faults.strange_topic(Fault(part, Kind.WRONG, 0.0, 1.0, 0.5)) == topic
