"""A sample of what `scripts/verify B` runs at full size; times are not judged here."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from needle_core.errors import UserError
from needle_verification.checking import Finding, Workbench
from needle_verification.checks import check_control
from needle_verification.checks.check_control import Size
from needle_verification.studies import control_studies, monte_carlo
from needle_verification.studies.control_studies import POINTS, TROUBLE, Measured, Study, judge

# The other troubles are steered on a plant of its own by needle_controller's tests.
SAMPLE = Size(
    draws=1,
    trouble=tuple(s for s in TROUBLE if s.key in {"all_troubles", "roll_160"}),
    points=tuple(s for s in POINTS if s.key == "points_moving"),
    insertions=300,
)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workbench:
    """Studies run in this process: what is compiled is loaded once."""

    def run(study: Study, folder: Path, draws: int, seed: str = control_studies.SEED) -> Measured:
        file = folder / f"{study.key}.json"
        words = ["--controller", study.controller, *study.options, "--draws", str(draws)]
        assert monte_carlo.main([*words, "--seed", seed, "--json", str(file)]) == 0
        return Measured(json.loads(file.read_text()), 0.0)

    monkeypatch.setattr(control_studies, "run", run)
    return Workbench(["simulate"], tmp_path)


@pytest.mark.parametrize(
    "check",
    [
        check_control.paper,
        check_control.figure_3,
        check_control.best,
        check_control.trouble,
        check_control.points,
        check_control.curvature,
    ],
    ids=lambda check: str(check.__name__),
)
def test_a_sample_shows_what_it_must(
    bench: Workbench, check: Callable[[Workbench, Size], Iterator[Finding]]
) -> None:
    findings = list(check(bench, SAMPLE))
    assert findings
    assert [finding for finding in findings if not finding.passed] == []


def test_the_node_s_update_is_timed_over_a_whole_run() -> None:
    seconds = check_control.update_times("best")
    assert seconds.shape == (121,)
    assert np.all(seconds >= 0.0)


def test_a_figure_that_falls_short_or_does_not_exist_is_a_miss() -> None:
    study = dataclasses.replace(
        control_studies.BEST, at_least={"share": 0.99}, at_most={"settle": 40.0, "rms": 0.2}
    )
    figures = {"share": 0.989, "settle": None, "rms": 0.2}
    assert [finding.passed for finding in judge(study, figures, 10)] == [False, False, True]
    # 1000 runs cannot tell 0.989 from 0.99.
    assert [finding.passed for finding in judge(study, figures, 1)] == [True, False, True]


def test_a_study_that_does_not_run_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control_studies, "find_executable", lambda *_: "/bin/false")
    study = Study("broken", "best", ())
    with pytest.raises(UserError, match="broken"):
        control_studies.run(study, tmp_path, 1)
