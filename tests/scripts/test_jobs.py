"""A signal that ends a script also ends its child processes in any state."""

import os
import signal
import subprocess
from pathlib import Path

import pytest

JOBS = Path(__file__).parents[2] / "scripts" / "lib" / "jobs.sh"
SCRIPT = """
. '{jobs}'
run bash -c 'echo $$; exec sleep 1000'
echo not reached
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_script_and_child(number: signal.Signals) -> None:
    with subprocess.Popen(
        ["bash", "-c", SCRIPT.format(jobs=JOBS)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        # tests may run in a background that ignores signals
        preexec_fn=lambda: [signal.signal(n, signal.SIG_DFL) for n in (1, 2)],  # noqa: PLW1509
    ) as script:
        assert script.stdout is not None
        child = int(script.stdout.readline())
        script.send_signal(number)
        rest, _ = script.communicate(timeout=60.0)
    assert (script.returncode, rest) == (130, "")
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)


def test_the_exit_code_of_a_command_is_passed_on() -> None:
    argv = ["bash", "-c", f". '{JOBS}'; run false; echo $code; run true; echo $code"]
    assert subprocess.run(argv, capture_output=True, text=True, check=True).stdout == "1\n0\n"


@pytest.mark.parametrize("script", ["simulate", "console", "verify", "paper", "bench", "test"])
def test_every_script_that_starts_others_forwards_signals(script: str) -> None:
    text = (JOBS.parents[1] / script).read_text("utf-8")
    assert "lib/jobs.sh" in text
    assert "exec python" not in text
