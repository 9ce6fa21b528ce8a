"""A node's start and end, without a graph."""

import dataclasses

import pytest
import rclpy
from rclpy.node import Node

from needle_common.base_node import STEADY_CLOCK, run_node
from needle_common.cli import EXIT_BAD_INPUT, EXIT_DONE, EXIT_INTERNAL_ERROR
from needle_common.errors import UserError


@dataclasses.dataclass(frozen=True)
class NoParameters:
    """None."""


def run(create: type[Node], *words: str) -> int:
    return run_node(create, help_text="HELP", parameters=NoParameters, args=["node", *words])


class EndsInACallback(Node):
    """Loses its context while a callback is under way, as a signal does it."""

    def __init__(self) -> None:
        super().__init__("ends_in_a_callback")
        self.create_timer(1e-3, self._on_timer, clock=STEADY_CLOCK)

    def _on_timer(self) -> None:
        rclpy.shutdown()
        raise RuntimeError("failed to publish: context is invalid")


class Fails(EndsInACallback):
    """Has a fault of its own."""

    def _on_timer(self) -> None:
        raise RuntimeError("a fault of its own")


class Refuses(Node):
    """Does not like its parameters."""

    def __init__(self) -> None:
        raise UserError("rate = 0 Hz, must be > 0")


def test_a_signal_in_the_middle_of_a_callback_is_a_clean_end() -> None:
    assert run(EndsInACallback) == EXIT_DONE


def test_a_fault_in_a_callback_is_an_internal_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(Fails) == EXIT_INTERNAL_ERROR
    assert "RuntimeError: a fault of its own (test_base_node.py:" in capsys.readouterr().err


def test_bad_parameters_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(Refuses) == EXIT_BAD_INPUT
    assert capsys.readouterr().err == "error: rate = 0 Hz, must be > 0\n"


@pytest.mark.parametrize("word", ["--help", "-h"])
def test_help_is_given_without_a_context(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(Refuses, word) == EXIT_DONE
    assert capsys.readouterr().out.startswith("HELP\n")


def test_an_unknown_argument_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(Refuses, "--fast") == EXIT_BAD_INPUT
    assert "'--fast'" in capsys.readouterr().err
