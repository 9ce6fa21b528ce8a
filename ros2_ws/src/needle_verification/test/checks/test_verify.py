"""`scripts/verify`: what it says, writes and returns, of checks whose findings are known."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from needle_core.errors import UserError
from needle_verification.checking import Finding, Workbench
from needle_verification.checks import verify

Out = pytest.CaptureFixture[str]


def good(_: Workbench) -> Iterator[Finding]:
    """Find what is wanted."""
    yield Finding("height", "its height", "2 m", "2.0 m", passed=True)


def bad(_: Workbench) -> Iterator[Finding]:
    """Find something else."""
    yield Finding("width", "its width", "1 m", "3 m", passed=False)


def impossible(_: Workbench) -> Iterator[Finding]:
    """Find nothing.

    The rest says why.
    """
    yield from ()
    raise UserError("there is no rig")


@pytest.fixture(autouse=True)
def steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verify, "STEPS", {"A": (good, bad), "B": (impossible,)})


def test_all_as_wanted_is_exit_code_0(capsys: Out) -> None:
    assert verify.main(["A", "--only", "good"]) == 0
    said = capsys.readouterr().out
    assert (
        said == "ok   A its height\n         wanted 2 m\n         seen   2.0 m\n1 of 1 as wanted\n"
    )


def test_what_falls_short_or_cannot_be_checked_is_exit_code_1(tmp_path: Path, capsys: Out) -> None:
    file = tmp_path / "findings.json"
    assert verify.main(["--json", str(file)]) == 1
    said = capsys.readouterr().out
    assert "MISS A its width\n" in said
    assert (
        "MISS B Find nothing.\n         wanted can be checked\n         seen   there is no" in said
    )
    assert said.endswith("1 of 3 as wanted\n")
    values = json.loads(file.read_text())
    assert (values["passed"], values["A_height"], values["A_width"]) == (False, True, False)
    assert (values["A_width_wanted"], values["B_impossible_seen"]) == ("1 m", "there is no rig")
    assert values["wall_s"] >= 0.0


def test_checks_are_listed_and_not_run(capsys: Out) -> None:
    assert verify.main(["--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(maxsplit=2) for line in lines] == [
        ["A", "good", "Find what is wanted."],
        ["A", "bad", "Find something else."],
        ["B", "impossible", "Find nothing."],
    ]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["C"], "step 'C' does not exist"),
        (["A", "--only", "impossible"], "--only 'impossible' is not one of good, bad"),
        (["A", "--keep", "/dev/null/here"], "--keep"),
    ],
)
def test_what_is_not_there_is_one_line_and_exit_code_2(
    capsys: Out, words: list[str], says: str
) -> None:
    assert verify.main(words) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert says in captured.err
    assert captured.err.count("\n") == 1
