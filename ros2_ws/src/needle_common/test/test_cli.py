"""Exit codes and one-line errors, as a shell sees them."""

import subprocess
import sys

import pytest

from needle_common.cli import EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_MISSED, run_command
from needle_common.errors import UserError


def raise_(error: BaseException) -> int:
    raise error


def test_a_users_error_is_one_line_and_exit_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(lambda: raise_(UserError("kappa = -1 1/m, must be > 0"))) == EXIT_BAD_INPUT
    assert capsys.readouterr().err == "error: kappa = -1 1/m, must be > 0\n"


def test_an_interrupt_is_exit_code_130(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(lambda: raise_(KeyboardInterrupt())) == EXIT_INTERRUPTED
    assert capsys.readouterr().err == "interrupted\n"


def test_the_commands_own_code_comes_through() -> None:
    assert run_command(lambda: EXIT_MISSED) == EXIT_MISSED


def test_a_programming_error_keeps_its_traceback() -> None:
    with pytest.raises(ZeroDivisionError):
        run_command(lambda: 1 // 0)


@pytest.mark.parametrize("lines", [1, 100_000])
def test_a_reader_that_leaves_is_no_error(lines: int) -> None:
    code = (
        "import sys, time; from needle_common.cli import run_command\n"
        "sys.stdin.read()\n"
        f"sys.exit(run_command(lambda: print('x\\n' * {lines}) or 0))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    process.stdout.close()
    assert process.stdin is not None
    process.stdin.close()
    process.stdin = process.stdout = None
    _, said = process.communicate(timeout=60.0)
    assert (process.returncode, said) == (0, "")
