"""Signals, in processes of their own: handlers are a process' own."""

from __future__ import annotations

import ctypes
import signal
import subprocess
import sys
import types

import pytest

from needle_core.process import late_exit

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


def test_a_process_that_does_not_look_at_the_flag_ends_in_the_grace() -> None:
    code = """
from needle_core.process.end_request import EndRequest, LeaveAtOnce
LeaveAtOnce(1)
with EndRequest(0.1, code=7):
    send(signal.SIGTERM)
    while True: pass
"""
    assert run(code) == (7, "")


def test_what_must_be_finished_first_is() -> None:
    code = """
from needle_core.process.end_request import TAKE_APART, EndRequest, LeaveAtOnce
LeaveAtOnce(1)
with EndRequest(None) as end:
    send(signal.SIGTERM)
    until = time.monotonic() + 2 * TAKE_APART
    while time.monotonic() < until: pass
    print("finished", flush=True)
    end.leave(3)
    while True: pass
"""
    assert run(code) == (3, "finished\n")


def test_an_end_comes_even_where_compiled_code_keeps_the_interpreter() -> None:
    # PyDLL calls without letting go of the interpreter's lock.
    code = """
import ctypes
from needle_core.process.end_request import EndRequest, LeaveAtOnce
LeaveAtOnce(1)
with EndRequest() as end:
    end.leave(5)
    ctypes.PyDLL(None).pause()
"""
    assert run(code) == (5, "")


@pytest.mark.parametrize("begin", ["LeaveAtOnce(7)", "LeaveAtOnce(1); EndRequest(0.1, code=7)"])
def test_an_end_after_a_signal_needs_no_interpreter(begin: str) -> None:
    # The signal comes while compiled code keeps the lock for good: a mutex is taken twice.
    code = f"""
import ctypes, subprocess
from needle_core.process.end_request import EndRequest, LeaveAtOnce
{begin}
wait = 'read go; until grep -q "^State:.S" /proc/$0/status; do :; done; kill -TERM $0'
held, mutex = ctypes.PyDLL(None), ctypes.create_string_buffer(64)
held.pthread_mutex_lock(mutex)
sender = subprocess.Popen(["sh", "-c", wait, str(os.getpid())], stdin=subprocess.PIPE)
sender.stdin.write(b"go\\n"); sender.stdin.flush()
held.pthread_mutex_lock(mutex)
"""
    assert run(code) == (7, "")


def test_a_command_that_was_loaded_takes_its_time_to_clean_up() -> None:
    code = """
from needle_core.process.end_request import TAKE_APART, LeaveAtOnce, interruptible
LeaveAtOnce(1)
try:
    with interruptible():
        send(signal.SIGTERM)
        while True: pass
except KeyboardInterrupt:
    until = time.monotonic() + 2 * TAKE_APART
    while time.monotonic() < until: pass
    print("cleaned up")
"""
    assert run(code) == (0, "cleaned up\n")


def test_the_end_after_a_signal_has_the_code_that_was_said_last() -> None:
    code = """
from needle_core.process import end_request
end_request.TAKE_APART = 60.0
end_request.LeaveAtOnce(1)
with end_request.EndRequest(0.1, code=7) as end:
    end.leave(5)
    send(signal.SIGTERM)
    while True: pass
"""
    assert run(code) == (5, "")


def test_a_tests_own_process_lives_on() -> None:
    code = """
from needle_core.process.end_request import TAKE_APART, EndRequest
before = signal.getsignal(signal.SIGTERM)
with EndRequest(0.01) as end:
    send(signal.SIGTERM)
    end.leave(9)
    until = time.monotonic() + 2 * TAKE_APART
    while time.monotonic() < until: pass
assert signal.getsignal(signal.SIGTERM) is before
"""
    assert run(code) == (0, "")


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


def test_the_reading_of_an_older_c_library_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    libc, librt = types.SimpleNamespace(), types.SimpleNamespace(aio_read=None)
    libraries = {None: libc, "librt.so.1": librt}
    monkeypatch.setattr(ctypes, "CDLL", lambda name, **_: libraries[name])
    assert vars(late_exit.system_library()) == {"aio_read": None}
    assert not vars(libc)
    libc.aio_read = None
    del librt.aio_read
    assert vars(late_exit.system_library()) == {"aio_read": None}
