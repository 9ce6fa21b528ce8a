"""Signals as a flag, in a process of its own: handlers are a process' own."""

import signal
import subprocess
import sys

import pytest

CODE = """
import os, signal
from needle_common.end_request import EndRequest
end = EndRequest(signal.SIGHUP)
print(end.wanted)
os.kill(os.getpid(), {number})
print(end.wanted)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_sets_the_flag_and_ends_nothing(number: signal.Signals) -> None:
    code = CODE.format(number=int(number))
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout) == (0, "False\nTrue\n"), run.stderr


def test_other_signals_end_as_ever() -> None:
    # Not SIGHUP: below nohup it is ignored.
    code = CODE.replace("signal.SIGHUP", "").format(number=int(signal.SIGUSR1))
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == -signal.SIGUSR1
