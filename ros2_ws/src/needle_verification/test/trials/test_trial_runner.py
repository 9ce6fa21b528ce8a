"""Trials that a command line asks for: their kinds, and what each draws."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from needle_core.commands.cli import EXIT_BAD_INPUT, EXIT_DONE
from needle_core.commands.options import CommandParser
from needle_core.errors import UserError
from needle_verification.trials.trial_runner import run_trials, trials_of

KINDS = ("cut", "stall")


def draws(*chosen: str, seed: int = 1) -> list[tuple[str, int, float]]:
    trials = trials_of(KINDS, chosen, 2, seed)
    return [(trial.kind, trial.number, trial.rng.random()) for trial in trials]


def test_a_kind_draws_the_same_whatever_else_is_tried() -> None:
    assert [(kind, number) for kind, number, _ in draws()] == [
        ("cut", 0), ("cut", 1), ("stall", 0), ("stall", 1)
    ]  # fmt: skip
    assert draws("stall") == draws()[2:]
    assert draws("stall")[0][2] != draws("cut")[0][2]
    assert draws("stall", seed=2) != draws("stall")


def test_a_kind_that_is_not_known_is_named() -> None:
    with pytest.raises(UserError, match="'unplug' is not one of cut, stall"):
        trials_of(KINDS, ["unplug"], 1, 1)
    with pytest.raises(UserError, match="count"):
        trials_of(KINDS, [], 0, 1)


def test_each_outcome_is_a_line_signed_with_kind_and_number(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*words: str) -> int:
        monkeypatch.setattr(sys, "argv", ["trials", *words])
        return run_trials(
            CommandParser("trials", "", ""),
            lambda given, folder, _: (
                trial.outcome({"logs": Path(trial.make_folder(folder)).name})
                for trial in trials_of(KINDS, given.kinds, given.count, given.seed)
            ),
        )

    assert run("2", "stall") == EXIT_DONE
    assert [json.loads(line) for line in capsys.readouterr().out.splitlines()] == [
        {"kind": "stall", "number": number, "logs": f"stall_{number}"} for number in range(2)
    ]
    assert run("1", "unplug") == EXIT_BAD_INPUT
