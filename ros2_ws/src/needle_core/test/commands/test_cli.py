"""Exit codes and one-line errors, as a shell sees them."""

import subprocess
import sys

import pytest

from needle_core.commands.cli import (
    EXIT_BAD_INPUT,
    EXIT_INTERNAL_ERROR,
    EXIT_INTERRUPTED,
    EXIT_MISSED,
    run_command,
)
from needle_core.errors import UserError


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


def test_an_internal_error_is_one_line_with_a_code_of_its_own(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run_command(lambda: raise_(ValueError("two\nlines"))) == EXIT_INTERNAL_ERROR == 3
    said = capsys.readouterr().err
    assert said.startswith(
        "error: internal error, please report it: ValueError: two lines (test_cl"
    )
    assert said.count("\n") == 1


def test_development_mode_shows_the_traceback() -> None:
    code = (
        "import sys; from needle_core.commands.cli import run_command; "
        "sys.exit(run_command(lambda: 1/0))"
    )
    process = subprocess.run(
        [sys.executable, "-X", "dev", "-c", code], capture_output=True, text=True, check=False
    )
    assert process.returncode == EXIT_INTERNAL_ERROR
    assert "Traceback" in process.stderr
    assert process.stderr.splitlines()[-1].startswith("error: internal error")


@pytest.mark.parametrize("lines", [1, 100_000])
def test_a_reader_that_leaves_is_no_error(lines: int) -> None:
    code = (
        "import sys, time; from needle_core.commands.cli import run_command\n"
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


def test_json_dash_is_all_there_is_on_standard_output() -> None:
    code = """
import sys
from needle_core.commands.cli import run_command, write_json
from needle_core.commands.options import CommandParser, output_file
def command():
    parser = CommandParser("c", "", "")
    parser.add_argument("--json")
    file = output_file("--json", parser.parse_args(["--json", "-"]).json)
    print("words")
    write_json(file, {"a": 1})
    return 0
code = run_command(command)
print("after")
sys.exit(code)
"""
    result = subprocess.run(
        [sys.executable, "-c", code], check=False, capture_output=True, text=True
    )
    assert (result.returncode, result.stderr) == (0, "words\n")
    assert result.stdout == '{\n  "a": 1\n}\nafter\n'
