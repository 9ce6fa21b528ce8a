"""Entry points and exit codes of commands and nodes."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import pytest

from needle_core.commands import cli, executables
from needle_core.commands.cli import run_command
from needle_core.errors import UserError
from needle_core.process import shutdown
from needle_core.process.shutdown import ENDING_SIGNALS, ShutdownFlag, interruptible


class LeftError(BaseException):
    """Stand-in for the end of the process by `os._exit`."""


@pytest.fixture(autouse=True)
def _handlers(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Keep the process alive, and restore all signal handlers."""

    def leave(code: int) -> NoReturn:
        raise LeftError(code)

    monkeypatch.setattr(os, "_exit", leave)
    before = {number: signal.getsignal(number) for number in ENDING_SIGNALS}
    # Background jobs of a shell, in which tests may run, ignore SIGINT; nohup ignores SIGHUP.
    for number in ENDING_SIGNALS:
        signal.signal(number, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def raise_(error: BaseException) -> int:
    raise error


def test_a_user_error_is_an_exit_code_and_one_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run_command(lambda: cli.EXIT_MISSED) == 1
    assert run_command(lambda: raise_(UserError("kappa = -1 1/m"))) == 2
    assert run_command(lambda: raise_(KeyboardInterrupt())) == 130
    assert capsys.readouterr().err == "error: kappa = -1 1/m\ninterrupted\n"


def test_an_internal_error_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(lambda: raise_(ValueError("two\nlines"))) == 3
    text = capsys.readouterr().err
    assert text.startswith("error: internal error, please report it: ValueError: two lines (test_c")
    assert text.count("\n") == 1


def test_a_closed_output_pipe_is_not_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    for count in (1, 10**6):
        reader, writer = os.pipe()
        os.close(reader)
        with os.fdopen(writer, "w") as stream:
            monkeypatch.setattr(sys, "stdout", stream)
            assert run_command(lambda n=count: print("x" * n) or 1) == 0  # type: ignore[misc]


# ---- signals ------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", ENDING_SIGNALS)
def test_a_signal_sets_the_flag_and_ends_nothing(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with ShutdownFlag() as end:
        assert not end.requested
        for _ in range(2):
            signal.raise_signal(number)
            assert end.requested
    assert signal.getsignal(number) is before


def test_an_ignored_hangup_stays_ignored() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with ShutdownFlag() as end:
        signal.raise_signal(signal.SIGHUP)
        assert not end.requested
    with interruptible():
        signal.raise_signal(signal.SIGHUP)


@pytest.mark.parametrize("number", ENDING_SIGNALS)
def test_a_repeated_signal_does_not_disturb_the_clean_up(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    now = 100.0
    monkeypatch.setattr(shutdown, "time", types.SimpleNamespace(monotonic=lambda: now))

    def work() -> int:
        nonlocal now
        try:
            signal.raise_signal(number)
            done.append("not interrupted")
        finally:
            now += 0.9
            signal.raise_signal(number)
            signal.raise_signal(signal.SIGINT)
            done.append("clean")
            now += 0.2
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(number)
        return 0

    assert run_command(work) == 130
    assert done == ["clean"]


@pytest.mark.parametrize("number", ENDING_SIGNALS)
@pytest.mark.parametrize(("kind", "code"), [(executables.node, 0), (executables.command, 130)])
def test_a_signal_while_modules_are_loaded_ends_at_once(
    kind: Callable[[str], Any], code: int, number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Also in a background job.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    monkeypatch.setattr(importlib, "import_module", lambda _: signal.raise_signal(number))
    with pytest.raises(LeftError) as left:
        kind("nothing")()
    assert left.value.args == (code,)


@pytest.mark.parametrize(
    ("kind", "end"), [(executables.node, LeftError), (executables.command, SystemExit)]
)
def test_the_exit_code_and_the_last_output_are_passed_on(
    kind: Callable[[str], Any],
    end: type[BaseException],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = tmp_path / "words"
    with file.open("w") as stream:

        def main() -> int:
            monkeypatch.setattr(sys, "stdout", stream)
            print("last words")
            return 4

        monkeypatch.setitem(sys.modules, "made_up", types.SimpleNamespace(main=main))
        with pytest.raises(end) as left:
            kind("made_up")()
        assert left.value.args == (4,)
        # A command exits through the interpreter, which flushes them.
        assert file.read_text() == ("last words\n" if end is LeftError else "")
