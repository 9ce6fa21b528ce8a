"""All descendants of a command end with it."""

import os
import subprocess
import sys

import pytest

from needle_bringup.workplace import ending_descendants, processes_with

# A child that starts another one in its own session.
CODE = """
import signal, subprocess, sys
ends = "import signal; print('on', flush=True); signal.pause()"
with subprocess.Popen(
    [sys.executable, "-c", ends], start_new_session=True, stdout=subprocess.PIPE
) as process:
    process.stdout.readline()
    print("on", flush=True)
    signal.pause()
"""


def test_none_is_left_after_an_interrupt() -> None:
    mark = {"NEEDLE_TEST_MARK": "descendants"}
    with pytest.raises(KeyboardInterrupt), ending_descendants():
        process = subprocess.Popen(
            [sys.executable, "-c", CODE], env={**os.environ, **mark}, stdout=subprocess.PIPE
        )
        assert process.stdout is not None
        with process.stdout as output:
            output.readline()
        assert len(processes_with(*mark.popitem())) == 2
        raise KeyboardInterrupt
    process.wait()
    assert processes_with("NEEDLE_TEST_MARK", "descendants") == []
