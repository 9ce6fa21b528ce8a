"""Signals, in processes of their own: handlers are a process' own."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


def run(code: str, *, ignored: signal.Signals | None = None) -> tuple[int, str]:
    """Run code that has `os`, `signal`, `send(number)`; return exit code and output."""
    begin = "import os, signal, sys, time\ndef send(n): os.kill(os.getpid(), n)\n"
    # A shell's background, where tests may run, ignores SIGINT.
    begin += "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    if ignored is not None:
        begin += f"signal.signal({int(ignored)}, signal.SIG_IGN)\n"
    command = [sys.executable, "-u", "-c", begin + code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)
    assert "Traceback" not in done.stderr
    return done.returncode, done.stdout


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_sets_the_flag_and_ends_nothing(number: signal.Signals) -> None:
    code = f"""
from needle_core.process.end_request import EndRequest
with EndRequest() as end:
    print(end.wanted)
    send({int(number)})
    send({int(number)})
    print(end.wanted)
"""
    assert run(code) == (0, "False\nTrue\n")


def test_other_signals_end_as_ever() -> None:
    code = "from needle_core.process.end_request import EndRequest\n"
    code += "EndRequest()\nsend(signal.SIGUSR1)"
    assert run(code) == (-signal.SIGUSR1, "")


def test_a_hangup_that_is_ignored_stays_so() -> None:
    code = """
from needle_core.process.end_request import EndRequest, interruptible
with EndRequest() as end:
    send(signal.SIGHUP)
    print(end.wanted)
with interruptible():
    send(signal.SIGHUP)
"""
    assert run(code, ignored=signal.SIGHUP) == (0, "False\n")


@pytest.mark.parametrize("number", SIGNALS)
def test_a_command_cleans_up_undisturbed(number: signal.Signals) -> None:
    code = f"""
from needle_core.commands.cli import run_command
def work():
    try:
        send({int(number)})
        time.sleep(60)
    finally:
        send({int(number)})
        send(signal.SIGINT)
        print("clean")
sys.exit(run_command(work))
"""
    assert run(code) == (130, "clean\n")


@pytest.mark.parametrize(("kind", "expected"), [("node", 0), ("command", 130)])
@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_while_modules_are_loaded_ends_at_once(
    kind: str, expected: int, number: signal.Signals
) -> None:
    code = f"""
import importlib
from needle_core.commands import executables
def load(name):
    send({int(number)})
    time.sleep(60)
importlib.import_module = load
executables.{kind}("nothing")()
"""
    assert run(code) == (expected, "")


def test_a_node_in_a_shells_background_is_heard_while_it_is_loaded() -> None:
    code = """
import importlib
from needle_core.commands import executables
def load(name):
    send(signal.SIGINT)
    time.sleep(60)
importlib.import_module = load
executables.node("nothing")()
"""
    assert run(code, ignored=signal.SIGINT) == (0, "")


@pytest.mark.parametrize("kind", ["node", "command"])
def test_the_exit_code_and_the_last_words_come_through(kind: str) -> None:
    code = f"""
import types
from needle_core.commands import executables
def main():
    sys.stdout = open(1, "w", closefd=False)
    print("last words")
    return 4
sys.modules["made_up"] = types.SimpleNamespace(main=main)
executables.{kind}("made_up")()
"""
    assert run(code) == (4, "last words\n")
