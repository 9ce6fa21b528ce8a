"""Report page of one or two bags: its content agrees with the runs."""

from __future__ import annotations

import dataclasses
import html
import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from needle_bags.figures.event_figure import lanes_of
from needle_bags.reading.bag_reader import HealthEvent, Result, Run, Status, read_run
from needle_bags.report import report
from needle_bags.report.pages import verdict_text
from needle_bags.rerun.rerun_bag import write_rerun
from needle_bags.run.run_summary import summarize, troubles
from needle_bags.run.stage_timing import STAGES
from needle_core.commands.cli import JsonValue

MakeRun = Callable[..., Path]
SECOND = 10**9
COMMAND = "scripts/simulate --level=tip --params='a <file>.yaml'"


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Collect the figures of a report without rendering them."""
    figures: list[Figure] = []
    dot = report._png(Figure(figsize=(0.1, 0.1)))

    def keep(figure: Figure) -> bytes:
        figures.append(figure)
        return dot

    monkeypatch.setattr(report, "_png", keep)
    monkeypatch.setattr(report, "plan_views", lambda *_: [])
    return figures


def assert_leads_nowhere_else(page: str) -> None:
    """Check that the page refers to no other file or site, and that its internal links resolve."""
    assert not re.search(r"(src|href)=.(?!data:|#)", page)
    assert not re.search(r"url\(|@import|//[\w-]+\.\w", re.sub(r"base64,[\w+/=]+", "", page))
    names = re.findall(r' id="([^"]+)"', page)
    assert len(names) == len(set(names))
    assert set(re.findall(r'href="#([^"]+)"', page)) <= set(names)


def test_the_report_is_one_self_contained_file(reported: tuple[Run, str]) -> None:
    run, page = reported
    assert_leads_nowhere_else(page)
    # Two drawings of the film and the figures, which are also files.
    figures = ("states", "path", "errors", "timing", "events")
    assert page.count("data:image/png;base64,") == len(figures) + 2
    for name in figures:
        assert (run.path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    contents = re.findall(r'<li><a href="#([^"]+)">([^<]+)</a>', page)
    assert contents == re.findall(r'<section id="([^"]+)"><h2>([^<]+)</h2>', page)
    rows = re.findall(r"<tr><td>([\w -]+)</td><td>[^<]*</td><td>(\d+)</td>", page)
    assert [name for name, _ in rows] == [name for name, _ in STAGES]
    assert all(120 <= int(count) <= 121 for _, count in rows)
    assert "Converged" in page


def test_texts_from_the_bag_are_escaped(
    reported: tuple[Run, str],
) -> None:
    run, page = reported
    assert "&lt;script&gt;alert(1)" in page
    assert "<script>alert" not in page
    section = page.partition('<section id="repeat-it">')[2]
    assert html.unescape(section.partition("<pre>")[2].partition("</pre>")[0]) == COMMAND
    assert f"needle_bags rerun {run.path}\n" in section


def test_a_report_without_truth_or_command(
    make_run: MakeRun, tmp_path: Path, drawn: list[Figure]
) -> None:
    bag, out = make_run(truth=False, steps=20, done=False), tmp_path / "out"
    figures = tmp_path / "figures.json"
    assert report.main([str(bag), "--json", str(figures), "--output", str(out)]) == 0
    page = (out / "report.html").read_text()
    assert "No ground truth" in page
    assert "does not say which command" in page
    assert len(drawn) == 4
    assert not (bag / "report.html").exists()
    values = json.loads(figures.read_text())
    assert values["converged"] is False
    for key in ("wall_s", "r1_final_mm", "r1_rms_last_20_mm", "tip_error_p95_mm"):
        assert values[key] is None


def test_two_bags_are_compared(make_run: MakeRun, tmp_path: Path, drawn: list[Figure]) -> None:
    first, second = make_run("first", steps=30), make_run("second", steps=20, done=False)
    figures = tmp_path / "figures.json"
    assert report.main([str(first), str(second), "--json", str(figures)]) == 0
    page = (second / "compared_with_first.html").read_text()
    assert len(drawn) == page.count("data:image/png;base64,") == 3
    assert_leads_nowhere_else(page)
    assert "Missed the plane / Not finished" in page
    values = json.loads(figures.read_text())
    assert values["a_steps"] == 30
    assert values["difference_steps"] == -10
    assert values["difference_r1_initial_mm"] == 0.0


def test_the_report_of_a_rerun(make_run: MakeRun, tmp_path: Path, drawn: list[Figure]) -> None:
    bag = make_run("steered", steps=20, command=COMMAND)
    run, again = read_run(bag), tmp_path / "again"
    write_rerun(run, again, [], {"/plane_controller": {"preset": "best"}}, "")
    rerun = read_run(again)
    summary = summarize(rerun)
    assert (summary["rerun_of"], summary["steered_by"]) == ("steered", "paper")
    assert summary["controller"] == "best"
    words, sentence = verdict_text(summary)
    assert words == "Rerun"
    assert "those that best would have sent" in sentence
    # The command belongs to the run in which the needle was inserted.
    assert "command" not in rerun.run_info
    third = tmp_path / "third"
    write_rerun(rerun, third, [], {"/plane_controller": {"preset": "open_loop"}}, "")
    assert summarize(read_run(third))["steered_by"] == "paper"
    # Both on one page: one needle, the commands of the run, and those of the rerun.
    assert report.main([str(bag), str(again)]) == 0
    labels = [line.get_label() for axes in drawn[0].axes for line in axes.lines]
    assert labels.count("A and B, truth") == 3
    assert "A, truth" not in labels
    assert {"A, commanded", "B, would have commanded, step by step"} < set(labels)


def test_events_omit_the_warnings_of_the_start(
    made_up: Run,
) -> None:
    begin = made_up.first_command
    assert begin is not None
    health = [
        HealthEvent(begin - 3 * SECOND, "sim_rig: simulation", 1, "waiting"),
        HealthEvent(begin - 2 * SECOND, "stereo_tracker: images", 1, "no images yet"),
        HealthEvent(begin - SECOND, "sim_rig: simulation", 0, "running"),
        HealthEvent(begin + SECOND, "stereo_tracker: images", 0, "ok"),
        HealthEvent(begin + 2 * SECOND, "sim_rig: simulation", 1, "waiting again"),
    ]

    def device(seconds: float, trips: int, reason: str) -> Status:
        values = {"state": "MOVING", "watchdog_trips": str(trips), "reason": reason}
        return Status(begin + round(seconds * SECOND), values)

    run = dataclasses.replace(
        made_up,
        health=health,
        results=[Result(begin + SECOND, 0, "aborted: hold released"), *made_up.results],
        device_status=[device(0.0, 1, "old"), device(0.5, 2, "no hold"), device(0.6, 2, "no hold")],
    )
    assert [(event.part, event.message) for event in troubles(run)] == [
        ("stereo_tracker: images", "no images yet"),
        ("device: watchdog", "no hold"),
        ("device: step", "aborted: hold released"),
        ("sim_rig: simulation", "waiting again"),
    ]
    lanes = lanes_of(run)
    assert {"controller", "device", "aborted steps"} < set(lanes)
    assert lanes["watchdogs"][0].begin == begin + SECOND // 2
    assert lanes["stereo_tracker: images"][0].end == begin + SECOND


def test_verdicts(make_run: MakeRun) -> None:
    stopped = summarize(read_run(make_run("stopped", steps=60, done=False)))
    assert verdict_text(stopped)[0] == "Not finished"
    assert "no tip for 2 s" in verdict_text(stopped)[1]
    run = read_run(make_run("missed", steps=60))
    assert verdict_text(summarize(run))[0] == "Missed the plane"
    last = run.controller_status[-1]

    def summary_at(text: str) -> dict[str, JsonValue]:
        status = dataclasses.replace(last, values={**last.values, "target_point_m": text})
        return summarize(dataclasses.replace(run, controller_status=[status]))

    # The verdict on a run to a point uses the point.
    x, y, z = run.truth.values[-1, :3]
    near = summary_at(f"{x!s}, {y + 0.0003!s}, {z - 0.0004!s}")
    assert near["point_error_mm"] == pytest.approx(0.5)
    assert near["converged"] is True
    assert "0.50 mm from the point" in verdict_text(near)[1]
    assert verdict_text(summary_at(f"{x!s}, {y + 0.002!s}, {z!s}"))[0] == "Missed the point"
    assert summary_at("1, 2")["point_error_mm"] is None


def test_an_image_of_a_wrong_size_gives_a_one_line_error(
    make_run: MakeRun, capsys: pytest.CaptureFixture[str]
) -> None:
    assert report.main([str(make_run(image_height=7, steps=3))]) == 2
    assert "an image declares 7 rows of 4 pixels" in capsys.readouterr().err
