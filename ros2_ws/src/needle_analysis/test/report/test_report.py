from __future__ import annotations

import dataclasses
import html
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from needle_analysis.figures.event_figure import lanes_of
from needle_analysis.figures.pair_figures import is_same_needle, pair_figures
from needle_analysis.report import report
from needle_analysis.report.glossary import TERMS, Glossary
from needle_analysis.report.report_page import verdict_text
from needle_analysis.rerun.rerun_bag import write_rerun
from needle_analysis.run.run_events import troubles
from needle_analysis.run.run_summary import commanded_rotation, summarize
from needle_analysis.run.stage_timing import STAGES
from needle_bags.reading.bag_reader import HealthEvent, Result, Status, read_run
from needle_core.commands.cli import JsonValue

MakeRun = Callable[..., Path]

REGRESSION = Path(__file__).resolve().parents[5] / "bags" / "regression"


def assert_leads_nowhere_else(page: str) -> None:
    """No reference to another file or place, and each within the page to something there."""
    assert not re.search(r"(src|href)=.(?!data:|#)", page)
    assert not re.search(r"url\(|@import|//[\w-]+\.\w", re.sub(r"base64,[\w+/=]+", "", page))
    names = re.findall(r' id="([^"]+)"', page)
    assert len(names) == len(set(names))
    assert set(re.findall(r'href="#([^"]+)"', page)) <= set(names)


def test_report_is_one_file_with_its_figures(make_run: MakeRun) -> None:
    bag = make_run()
    assert report.main([str(bag)]) == 0
    page = (bag / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 5 + 2
    assert_leads_nowhere_else(page)
    assert "Converged" in page
    for name in ("states", "path", "errors", "timing", "events"):
        assert (bag / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_output_and_json(make_run: MakeRun, tmp_path: Path) -> None:
    bag = make_run()
    figures = tmp_path / "figures.json"
    assert report.main([str(bag), "--json", str(figures), "--output", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "report.html").is_file()
    assert not (bag / "report.html").exists()
    values = json.loads(figures.read_text())
    assert values["converged"] is True
    assert values["wall_s"] is None


def test_report_without_truth(make_run: MakeRun) -> None:
    bag = make_run(truth=False)
    assert report.main([str(bag)]) == 0
    page = (bag / "report.html").read_text()
    assert "No ground truth" in page
    assert page.count("data:image/png;base64,") == 4 + 2


def test_a_tip_that_is_not_a_number_spoils_no_figure(make_run: MakeRun) -> None:
    bag = make_run(bad_tip=60)
    summary = summarize(read_run(bag))
    assert summary["tip_error_p95_mm"] == pytest.approx(0.5)
    assert summary["tips_not_finite"] == 1
    assert report.main([str(bag)]) == 0


def test_the_regression_bag_shows_everything(tmp_path: Path) -> None:
    assert report.main([str(REGRESSION), "--output", str(tmp_path)]) == 0
    page = (tmp_path / "report.html").read_text()
    for heading in ("What the cameras saw", "Innovation and gate", "Timing of each stage"):
        assert f"<h2>{heading}</h2>" in page
    rows = re.findall(r"<tr><td>([\w -]+)</td><td>[^<]*</td><td>(\d+)</td>", page)
    assert [name for name, _ in rows] == [name for name, _ in STAGES]
    assert all(120 <= int(count) <= 121 for _, count in rows)


def test_two_bags_are_compared(make_run: MakeRun, tmp_path: Path) -> None:
    first, second = make_run("first"), make_run("second", steps=110, done=False)
    figures = tmp_path / "figures.json"
    assert report.main([str(first), str(second), "--json", str(figures)]) == 0
    page = (second / "compared_with_first.html").read_text()
    assert page.count("data:image/png;base64,") == 3
    assert_leads_nowhere_else(page)
    assert "Converged / Not finished" in page
    values = json.loads(figures.read_text())
    assert values["a_steps"] == 120
    assert values["difference_steps"] == -10
    assert values["difference_r1_initial_mm"] == 0.0


def test_a_rerun_says_that_nothing_was_steered(make_run: MakeRun, tmp_path: Path) -> None:
    bag = make_run("steered")
    run, again = read_run(bag), tmp_path / "again"
    write_rerun(run, again, [], {"/plane_controller": {"preset": "best"}}, "")
    rerun = read_run(again)
    summary = summarize(rerun)
    assert (summary["rerun_of"], summary["steered_by"]) == ("steered", "paper")
    assert summary["controller"] == "best"
    words, sentence = verdict_text(summary)
    assert words == "Rerun"
    assert "those of steered, which paper steered" in sentence
    assert "what best would have said" in sentence
    third = tmp_path / "third"
    write_rerun(rerun, third, [], {"/plane_controller": {"preset": "open_loop"}}, "")
    assert summarize(read_run(third))["steered_by"] == "paper"
    # Both in one page: one needle, and what each commanded, or only would have.
    assert is_same_needle((run, rerun))
    states = pair_figures(run, rerun)["pair_states"].axes
    labels = [line.get_label() for axes in states for line in axes.lines]
    assert labels.count("A and B, truth") == 3
    assert "A, truth" not in labels
    assert {"A commanded", "B would have commanded"} < set(labels)
    assert not is_same_needle((run, run))
    assert report.main([str(bag), str(again)]) == 0
    page = (again / "compared_with_steered.html").read_text()
    assert "Converged / Rerun" in page
    assert "what the needle did is the same in both" in page


def test_turns_are_from_where_the_base_was(make_run: MakeRun) -> None:
    run = read_run(make_run())
    commands = run.joints.values + np.array([1e-3, 0.25])
    run = dataclasses.replace(run, commands=dataclasses.replace(run.joints, values=commands))
    insertion, begin, end = commanded_rotation(run).T
    np.testing.assert_allclose(insertion, run.joints.values[:, 0])
    np.testing.assert_allclose(end - begin, 0.25)


def test_lanes_show_what_was_when(make_run: MakeRun) -> None:
    run = read_run(make_run(steps=60, done=False))
    second = 10**9
    begin = run.controller_status[0].log_time
    health = [
        HealthEvent(begin + second, "stereo_tracker: track", 1, "LOST"),
        HealthEvent(begin + 2 * second, "stereo_tracker: track", 0, "ok"),
    ]
    stopped = Result(begin + second, 0, "aborted: hold released")
    lanes = {
        lane.name: lane.spans
        for lane in lanes_of(
            dataclasses.replace(run, health=health, results=[*run.results, stopped])
        )
    }
    assert set(lanes) == {"controller", "device", "stereo_tracker: track", "aborted steps"}
    (warning,) = lanes["stereo_tracker: track"]
    assert (warning.begin, warning.end) == (begin + second, begin + 2 * second)
    assert len(lanes["aborted steps"]) == 1
    steering, _ = lanes["controller"]
    assert steering.begin == begin


def test_troubles_are_what_went_wrong_and_not_how_every_run_starts(make_run: MakeRun) -> None:
    run = read_run(make_run())
    begin, second = run.first_command, 10**9
    assert begin is not None
    health = [
        HealthEvent(begin - 3 * second, "sim_rig: simulation", 1, "waiting"),
        HealthEvent(begin - 2 * second, "stereo_tracker: images", 1, "no images yet"),
        HealthEvent(begin - second, "sim_rig: simulation", 0, "running"),
        HealthEvent(begin + 2 * second, "sim_rig: simulation", 1, "waiting again"),
    ]

    def device(seconds: float, trips: int, reason: str) -> Status:
        values = {"state": "MOVING", "watchdog_trips": str(trips), "reason": reason}
        return Status(begin + round(seconds * second), values)

    run = dataclasses.replace(
        run,
        health=health,
        results=[Result(begin + second, 0, "aborted: hold released"), *run.results],
        device_status=[device(0.0, 1, "old"), device(0.5, 2, "no hold"), device(0.6, 2, "no hold")],
    )
    assert [(event.part, event.message) for event in troubles(run)] == [
        ("stereo_tracker: images", "no images yet"),
        ("device: watchdog", "no hold"),
        ("device: step", "aborted: hold released"),
        ("sim_rig: simulation", "waiting again"),
    ]
    lanes = {lane.name: lane.spans for lane in lanes_of(run)}
    assert lanes["watchdogs"][0].begin == begin + second // 2
    (waiting,) = lanes["sim_rig: simulation"]
    assert waiting.begin == begin + 2 * second


def test_verdicts(make_run: MakeRun) -> None:
    stopped = summarize(read_run(make_run("stopped", steps=60, done=False)))
    assert verdict_text(stopped)[0] == "Not finished"
    assert "no tip for 2 s" in verdict_text(stopped)[1]
    missed = summarize(read_run(make_run("missed", steps=60)))
    assert verdict_text(missed)[0] == "Missed the plane"


def test_a_run_to_a_point_is_judged_by_the_point(make_run: MakeRun) -> None:
    run = read_run(make_run("to_a_point", steps=60))
    last = run.controller_status[-1]

    def told(text: str) -> dict[str, JsonValue]:
        status = dataclasses.replace(last, values={**last.values, "target_point_m": text})
        return summarize(dataclasses.replace(run, controller_status=[status]))

    x, y, z = run.truth.values[-1, :3]
    near = told(f"{x!s}, {y + 0.0003!s}, {z - 0.0004!s}")
    assert near["point_error_mm"] == pytest.approx(0.5)
    assert near["converged"] is True
    assert "0.50 mm from the wanted point" in verdict_text(near)[1]
    far = told(f"{x!s}, {y + 0.002!s}, {z!s}")
    assert far["converged"] is False
    assert verdict_text(far)[0] == "Missed the point"
    for nothing in ("", "1, 2", "a, b, c"):
        assert told(nothing)["point_error_mm"] is None


def test_texts_from_the_bag_cannot_be_markup(make_run: MakeRun) -> None:
    bag = make_run(calibration="<script>alert(1)</script>")
    assert report.main([str(bag)]) == 0
    page = (bag / "report.html").read_text()
    assert "&lt;script&gt;alert(1)" in page
    assert "<script>alert" not in page


def test_a_missing_bag_is_exit_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert report.main([str(tmp_path / "none")]) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert "no such bag" in printed


def test_help_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        report.main(["--help"])
    assert ended.value.code == 0
    assert "exit codes" in capsys.readouterr().out


def test_contents_lead_to_every_section(make_run: MakeRun) -> None:
    bag = make_run()
    assert report.main([str(bag)]) == 0
    page = (bag / "report.html").read_text()
    contents = re.findall(r'<li><a href="#([^"]+)">([^<]+)</a>', page)
    headings = re.findall(r'<section id="([^"]+)"><h2>([^<]+)</h2>', page)
    assert len(contents) > 8
    assert contents == headings


def test_the_command_that_repeats_the_run_is_the_recorded_one(make_run: MakeRun) -> None:
    command = "scripts/simulate --level=tip --params='a <file>.yaml'"
    bag = make_run(command=command)
    assert report.main([str(bag)]) == 0
    section = (bag / "report.html").read_text().partition('<section id="repeat-it">')[2]
    assert html.unescape(section.partition("<pre>")[2].partition("</pre>")[0]) == command
    assert f"needle_analysis rerun {bag}\n" in section
    by_hand = make_run("by_hand")
    assert report.main([str(by_hand)]) == 0
    assert "does not say which command" in (by_hand / "report.html").read_text()
    again = bag.parent / "again"
    write_rerun(read_run(bag), again, [], {}, "")
    assert "command" not in read_run(again).run_info


def test_a_term_is_explained_once_where_it_stands_first() -> None:
    glossary = Glossary()
    first = glossary.explain("The [roll] is < [turned|roll] by the [hold].")
    assert first.count('id="term-roll"') == 1
    assert first.count('href="#term-roll"') == 2
    assert "&lt;" in first
    again = glossary.explain("[roll] and [95 %]")
    assert 'id="term-roll"' not in again
    assert 'id="term-95"' in again
    with pytest.raises(KeyError):
        glossary.explain("[what nobody knows]")


def test_every_term_of_the_glossary_is_used(tmp_path: Path) -> None:
    text = "".join(path.read_text() for path in Path(report.__file__).parent.glob("*_page.py"))
    used = {b or a for a, b in re.findall(r"\[([^\]|\[\n\"]+)(?:\|([^\]\n\"]+))?\]", text)}
    assert set(TERMS) <= used
