from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from needle_bringup import report
from needle_bringup.bag_reader import read_run
from needle_bringup.report_page import verdict_text
from needle_bringup.run_summary import summarize

MakeRun = Callable[..., Path]


def test_report_is_one_file_with_its_figures(make_run: MakeRun) -> None:
    bag = make_run()
    assert report.main([str(bag)]) == 0
    page = (bag / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 3
    assert not re.search(r"(src|href)=.(?!data:)", page)
    assert "<script" not in page
    assert "Converged" in page
    for name in ("states", "path", "errors"):
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
    assert page.count("data:image/png;base64,") == 2


def test_verdicts(make_run: MakeRun) -> None:
    stopped = summarize(read_run(make_run("stopped", steps=60, done=False)))
    assert verdict_text(stopped)[0] == "Not finished"
    assert "no tip for 2 s" in verdict_text(stopped)[1]
    missed = summarize(read_run(make_run("missed", steps=60)))
    assert verdict_text(missed)[0] == "Missed the plane"


def test_texts_from_the_bag_cannot_be_markup(make_run: MakeRun) -> None:
    bag = make_run(calibration="<script>alert(1)</script>")
    assert report.main([str(bag)]) == 0
    assert "<script" not in (bag / "report.html").read_text()


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
