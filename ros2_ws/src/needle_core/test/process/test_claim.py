"""A name that one process has at a time."""

from __future__ import annotations

import subprocess
import sys
import uuid

import pytest

from needle_core.errors import UserError
from needle_core.process.claim import Claim

HOLD = """
import sys
from needle_core.process.claim import Claim
claim = Claim(sys.argv[1], "/first")
print("has it", flush=True)
sys.stdin.read()
"""


def test_who_comes_second_is_told_who_has_it_and_a_kill_frees_it() -> None:
    name = f"/device/status {uuid.uuid4()}"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, name], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == b"has it\n"
        with pytest.raises(UserError, match=rf"/first \(process {first.pid}\) has {name}"):
            Claim(name, "/second")
        first.kill()
        first.wait()
        Claim(name, "/second").release()


def test_names_do_not_meet_and_a_released_one_is_free() -> None:
    name = str(uuid.uuid4())
    one, other = Claim(name, "/a"), Claim(f"{name} too", "/b")
    one.release()
    again = Claim(name, "/c")
    again.release()
    again.release()
    other.release()
